//! Compiles the C++ shim (`cpp/`) against Pinocchio's headers and links Pinocchio's library. Where they are is looked for in this
//! order: the Python packages under `NEARL_SITE_PACKAGES` (set in `.cargo/config.toml`, filled by `make setup`), `PINOCCHIO_PREFIX`,
//! `pkg-config`, a conda environment, ROS, and the packages of `python3`.
//!
//! `cargo:rustc-link-arg` reaches only this crate's own tests and examples. A crate that links the final binary
//! repeats it from the metadata this script publishes; see the crate documentation, section "Linking".

use std::path::{Path, PathBuf};
use std::process::Command;
use std::{env, fs};

/// What makes a folder an installation of Pinocchio.
const NEEDED: [&str; 2] = ["include/pinocchio/config.hpp", "lib/libpinocchio_default.so"];

/// Exported CMake targets that carry the compile definitions of the wheels.
const TARGETS: [&str; 2] = ["lib/cmake/pinocchio/pinocchioTargets.cmake", "lib/cmake/coal/coalTargets.cmake"];

const SOURCES: [&str; 3] = ["cpp/build.cpp", "cpp/dynamics.cpp", "cpp/kinematics.cpp"];

fn main() {
    for variable in ["NEARL_SITE_PACKAGES", "PINOCCHIO_PREFIX", "CONDA_PREFIX", "ROS_DISTRO", "DOCS_RS"] {
        println!("cargo:rerun-if-env-changed={variable}");
    }
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rerun-if-changed=cpp");
    // Documentation alone, where no Pinocchio is: nothing is compiled against it, nothing is linked.
    if env::var_os("DOCS_RS").is_some() {
        return;
    }

    let prefix = prefix();
    let include = prefix.join("include");
    let mut build = cc::Build::new();
    build.cpp(true).std("c++17").warnings(false).flag("-w").opt_level(2).debug(false).files(SOURCES);
    // Messages of failed assertions name the header's place in Pinocchio, not the folder of the machine that built.
    build.flag(format!("-ffile-prefix-map={}=pinocchio", prefix.display()));
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

/// Where Pinocchio is installed. What the two variables name is used or refused; what else is found is used.
fn prefix() -> PathBuf {
    for (variable, below) in [("NEARL_SITE_PACKAGES", "cmeel.prefix"), ("PINOCCHIO_PREFIX", "")] {
        let Some(folder) = env::var_os(variable) else { continue };
        let prefix = Path::new(&folder).join(below);
        if let Some(file) = NEEDED.iter().find(|file| !prefix.join(file).exists()) {
            let missing = prefix.join(file);
            panic!(
                "{variable} is set, but {} is missing: run `make setup`, or name another folder",
                missing.display()
            );
        }
        return fs::canonicalize(&prefix).unwrap_or(prefix);
    }
    let found = said_by("pkg-config", &["--variable=prefix", "pinocchio"])
        .into_iter()
        .chain(env::var_os("CONDA_PREFIX").map(PathBuf::from))
        .chain(env::var_os("ROS_DISTRO").map(|name| Path::new("/opt/ros").join(name)))
        .chain(said_by(
            "python3",
            &["-c", "import sysconfig; print(sysconfig.get_paths()['purelib'] + '/cmeel.prefix')"],
        ));
    found.into_iter().find(|prefix| NEEDED.iter().all(|file| prefix.join(file).exists())).unwrap_or_else(|| {
        panic!(
            "Pinocchio was found neither by NEARL_SITE_PACKAGES, PINOCCHIO_PREFIX, pkg-config, conda and ROS nor in python3's packages: \
             `pip install libpinocchio==4.1.0 cmeel-eigen==3.4.1`, or set PINOCCHIO_PREFIX to the folder that has include/pinocchio"
        )
    })
}

/// The folder that a program prints, if there is such a program and it succeeds.
fn said_by(program: &str, arguments: &[&str]) -> Option<PathBuf> {
    let run = Command::new(program).args(arguments).output().ok().filter(|run| run.status.success())?;
    Some(PathBuf::from(String::from_utf8(run.stdout).ok()?.trim()))
}

/// The definitions the wheels were built with; they decide the memory layout, so they are read and never typed in.
fn exported_definitions(prefix: &Path) -> Vec<String> {
    let mut found = Vec::new();
    for target in TARGETS {
        let path = prefix.join(target);
        if target.contains("coal") && !path.exists() {
            continue; // outside the wheels it may be installed elsewhere; without it Pinocchio has no definitions of its
        }
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
