//! Lets the driver find Pinocchio's library at run time.

fn main() {
    println!(
        "cargo::rustc-link-arg=-Wl,-rpath,{}",
        std::env::var("DEP_NEARL_PINOCCHIO_LIB").expect("nearl-constraints says where Pinocchio is")
    );
}
