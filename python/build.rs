//! Tells the extension where MuJoCo's and Pinocchio's libraries are at run time.
//!
//! Installed, `nearl/_core.abi3.so` lies beside the Python packages that carry them (`mujoco/` and `cmeel.prefix/lib/`), so
//! both are found relative to it, one mapped copy each, whether or not `import mujoco` came first. No path of the machine that
//! builds is left inside.

fn main() {
    println!("cargo::rerun-if-env-changed=NEARL_SITE_PACKAGES");
    let Ok(site_packages) = std::env::var("NEARL_SITE_PACKAGES") else {
        println!(
            "cargo::error=NEARL_SITE_PACKAGES is not set: build inside the checkout, where .cargo/config.toml sets it"
        );
        return;
    };
    println!("cargo::rustc-link-arg=-Wl,--wrap=hypot"); // see trainer/src/hypot.rs
    for (installed, package) in [("cmeel.prefix/lib", "libpinocchio==4.1.0"), ("mujoco", "mujoco==3.17.0")] {
        let here = format!("{site_packages}/{installed}");
        if !std::path::Path::new(&here).is_dir() {
            println!("cargo::error={here} is missing (Python package {package}): run `make setup` first");
        }
        println!("cargo::rustc-link-arg=-Wl,-rpath,$ORIGIN/../{installed}");
        println!("cargo::rustc-link-arg=-Wl,-rpath-link,{here}");
    }
}
