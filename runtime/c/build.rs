//! Lets this package's programs and tests find Pinocchio's libraries at run time: a link argument reaches one package
//! alone, so every package that links repeats it.

fn main() {
    println!("cargo::rerun-if-env-changed=NEARL_SITE_PACKAGES");
    if let Ok(site) = std::env::var("NEARL_SITE_PACKAGES") {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{site}/cmeel.prefix/lib");
    }
    println!("cargo::rustc-link-arg=-Wl,-rpath,$ORIGIN/../lib");
}
