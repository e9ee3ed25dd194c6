//! Lets the test programs find MuJoCo's library at run time (a link argument reaches one package only).

fn main() {
    println!("cargo::rerun-if-env-changed=MUJOCO_DYNAMIC_LINK_DIR");
    match std::env::var("MUJOCO_DYNAMIC_LINK_DIR") {
        Ok(folder) => println!("cargo::rustc-link-arg=-Wl,-rpath,{folder}"),
        Err(_) => println!("cargo::error=MUJOCO_DYNAMIC_LINK_DIR is not set: run cargo inside the checkout"),
    }
    println!("cargo::rerun-if-env-changed=NEARL_SITE_PACKAGES");
    if let Ok(site) = std::env::var("NEARL_SITE_PACKAGES") {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{site}/cmeel.prefix/lib");
    }
}
