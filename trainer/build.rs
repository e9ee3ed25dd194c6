//! Lets this package's programs and tests find MuJoCo's library at run time.

fn main() {
    println!("cargo::rerun-if-env-changed=MUJOCO_DYNAMIC_LINK_DIR");
    let Ok(folder) = std::env::var("MUJOCO_DYNAMIC_LINK_DIR") else {
        println!(
            "cargo::error=MUJOCO_DYNAMIC_LINK_DIR is not set: run cargo inside the checkout, where .cargo/config.toml sets it"
        );
        return;
    };
    if !std::path::Path::new(&folder).join("libmujoco.so").is_file() {
        println!("cargo::error={folder}/libmujoco.so is missing: run `make setup` first");
    }
    // A link argument reaches this package alone: crates that link it repeat these two lines in their build.rs.
    println!("cargo::rustc-link-arg=-Wl,-rpath,{folder}");
    println!("cargo::rustc-link-arg=-Wl,-rpath,$ORIGIN/../lib");
    println!("cargo::rustc-link-arg=-Wl,--wrap=hypot"); // see src/hypot.rs
    println!("cargo::rerun-if-env-changed=NEARL_SITE_PACKAGES");
    if let Ok(site) = std::env::var("NEARL_SITE_PACKAGES") {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{site}/cmeel.prefix/lib");
    }
}
