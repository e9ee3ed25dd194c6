//! Compiles the C++ shim (`cpp/`) against Pinocchio's headers and links Pinocchio's libraries, both from the
//! wheels under `NEARL_SITE_PACKAGES` (set in `.cargo/config.toml`, filled by `make setup`).
//!
//! `cargo:rustc-link-arg` reaches only this crate's own tests and examples. A crate that links the final binary
//! repeats it from the metadata this script publishes; see the crate documentation, section "Linking".

use std::path::{Path, PathBuf};
use std::{env, fs};

/// What the wheels must hold, with the package that brings it.
const NEEDED: [(&str, &str); 3] = [
    ("include/pinocchio/config.hpp", "libpinocchio"),
    ("include/eigen3/Eigen/Core", "cmeel-eigen"),
    ("lib/libpinocchio_default.so", "libpinocchio"),
];

/// Exported CMake targets that carry the compile definitions of the wheels.
const TARGETS: [&str; 2] = ["lib/cmake/pinocchio/pinocchioTargets.cmake", "lib/cmake/coal/coalTargets.cmake"];

const SOURCES: [&str; 3] = ["cpp/build.cpp", "cpp/dynamics.cpp", "cpp/kinematics.cpp"];

fn main() {
    println!("cargo:rerun-if-env-changed=NEARL_SITE_PACKAGES");
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rerun-if-changed=cpp");

    let prefix = prefix();
    let include = prefix.join("include");
    let mut build = cc::Build::new();
    build.cpp(true).std("c++17").warnings(false).flag("-w").opt_level(2).debug(false).files(SOURCES);
    for folder in ["", "eigen3"] {
        build.flag("-isystem").flag(include.join(folder));
    }
    for definition in exported_definitions(&prefix) {
        match definition.split_once('=') {
            Some((key, value)) => build.define(key, value),
            None => build.define(&definition, None),
        };
    }
    build.compile("nearl_pinocchio");

    let lib = prefix.join("lib");
    println!("cargo:rustc-link-search=native={}", lib.display());
    println!("cargo:rustc-link-lib=dylib=pinocchio_default");
    println!("cargo:rustc-link-arg=-Wl,-rpath-link,{}", lib.display());
    println!("cargo:rustc-link-arg=-Wl,-rpath,{}", lib.display());
    println!("cargo:lib={}", lib.display()); // DEP_NEARL_PINOCCHIO_LIB in the build scripts of dependants
}

/// The folder `cmeel.prefix` of the wheels.
fn prefix() -> PathBuf {
    let site = env::var("NEARL_SITE_PACKAGES").unwrap_or_else(|_| {
        panic!("NEARL_SITE_PACKAGES is not set: run cargo inside the repository after `make setup`, or set it to the `.venv/lib/python3.11/site-packages` there")
    });
    let prefix = Path::new(&site).join("cmeel.prefix");
    for (file, package) in NEEDED {
        let path = prefix.join(file);
        assert!(
            path.exists(),
            "{} is missing (Python package {package}): run `make setup` first",
            path.display()
        );
    }
    fs::canonicalize(&prefix).unwrap_or(prefix)
}

/// The definitions the wheels were built with; they decide the memory layout, so they are read and never typed in.
fn exported_definitions(prefix: &Path) -> Vec<String> {
    let mut found = Vec::new();
    for target in TARGETS {
        let path = prefix.join(target);
        println!("cargo:rerun-if-changed={}", path.display());
        let text = fs::read_to_string(&path)
            .unwrap_or_else(|error| panic!("{}: {error}: run `make setup` again", path.display()));
        let lines = text.lines().filter(|line| line.contains("INTERFACE_COMPILE_DEFINITIONS"));
        for list in lines.filter_map(|line| line.split('"').nth(1)) {
            let plain = |name: &&str| {
                let hpp_fcl = name.contains("HPP_FCL") && *name != "COAL_BACKWARD_COMPATIBILITY_WITH_HPP_FCL";
                !name.is_empty() && !name.contains('$') && !hpp_fcl
            };
            found.extend(list.split(';').filter(plain).map(String::from));
        }
    }
    found.sort();
    found.dedup();
    found
}
