//! The dependency arrows of docs/ARCHITECTURE.md, read from cargo itself.

use cargo_metadata::{DependencyKind, MetadataCommand};
use std::collections::BTreeMap;

/// Crate -> the workspace crates it may import.
const ARROWS: &[(&str, &[&str])] = &[
    ("nearl-constraints", &[]),
    ("nearl-runtime", &["nearl-constraints"]),
    ("nearl-trainer", &["nearl-runtime"]),
    ("nearl-python", &["nearl-constraints", "nearl-runtime", "nearl-trainer"]),
    ("nearl-tests", &["nearl-constraints", "nearl-runtime", "nearl-trainer"]),
];

/// Libraries that only one crate (and those above it) may name.
const OWNED: &[(&str, &str)] = &[
    ("clarabel", "nearl-constraints"),
    ("iceoryx2", "nearl-runtime"),
    ("mujoco-rs", "nearl-trainer"),
    ("pyo3", "nearl-python"),
];

#[test]
fn no_other_arrow_exists() {
    let metadata = MetadataCommand::new().no_deps().exec().expect("cargo metadata runs");
    let allowed: BTreeMap<_, _> = ARROWS.iter().copied().collect();
    assert_eq!(
        metadata.packages.len(),
        ARROWS.len(),
        "a crate was added: draw its arrows in docs/ARCHITECTURE.md and here"
    );
    for package in &metadata.packages {
        let name = package.name.as_str();
        for dependency in &package.dependencies {
            let to = dependency.name.as_str();
            if to.starts_with("nearl-") {
                assert!(
                    allowed[name].contains(&to),
                    "{name} imports {to}, which docs/ARCHITECTURE.md does not draw"
                );
            }
            if let Some((_, owner)) = OWNED.iter().find(|(library, _)| *library == to)
                && dependency.kind == DependencyKind::Normal
            {
                assert_eq!(name, *owner, "{name} names {to}, which belongs to {owner}");
            }
        }
    }
}

#[test]
fn extension_module_is_not_built_by_default() {
    let manifest = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../Cargo.toml"))
        .expect("workspace manifest");
    let line = manifest.lines().find(|l| l.starts_with("default-members")).expect("default-members");
    assert!(!line.contains("python"), "bare cargo commands must not need a Python: {line}");
}
