//! The dependency arrows of docs/ARCHITECTURE.md, read from cargo itself.

use cargo_metadata::{DependencyKind, Metadata, MetadataCommand, NodeDep};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Crate -> the workspace crates it may import.
const ARROWS: &[(&str, &[&str])] = &[
    ("nearl-constraints", &[]),
    ("nearl-controller", &["nearl-constraints"]),
    ("nearl-verify", &[]),
    ("nearl-runtime", &["nearl-constraints", "nearl-controller", "nearl-verify"]),
    ("nearl-c", &["nearl-runtime"]),
    ("nearl-rollout-protocol", &["nearl-runtime"]),
    ("nearl-trainer", &["nearl-runtime", "nearl-rollout-protocol"]),
    ("nearl-python", &["nearl-constraints", "nearl-runtime", "nearl-trainer"]),
    ("nearl-tests", &["nearl-constraints", "nearl-runtime", "nearl-trainer", "nearl-verify"]),
];

/// What a program that embeds the controller must not have to build: links, command lines, logs, physics, Python.
const NOT_EMBEDDED: &[&str] =
    &["iceoryx2", "clap", "mcap", "rtrb", "rayon", "signal-hook", "mujoco-rs", "pyo3"];

/// Libraries that only these crates may name.
const OWNED: &[(&str, &[&str])] = &[
    ("clarabel", &["nearl-constraints", "nearl-trainer"]),
    ("iceoryx2", &["nearl-runtime", "nearl-rollout-protocol"]),
    ("mujoco-rs", &["nearl-trainer"]),
    ("pyo3", &["nearl-python"]),
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
            if let Some((_, owners)) = OWNED.iter().find(|(library, _)| *library == to)
                && dependency.kind == DependencyKind::Normal
            {
                assert!(owners.contains(&name), "{name} names {to}, which belongs to {owners:?}");
            }
        }
    }
}

/// Every package that a build of `name` compiles into it or for it, itself included.
fn packages<'a>(metadata: &'a Metadata, name: &str) -> BTreeSet<&'a str> {
    let resolve = metadata.resolve.as_ref().expect("a resolved graph");
    let nodes: BTreeMap<_, _> = resolve.nodes.iter().map(|node| (&node.id, node)).collect();
    let package: BTreeMap<_, _> = metadata.packages.iter().map(|p| (&p.id, p)).collect();
    let mut open: Vec<_> = package.values().filter(|p| p.name.as_str() == name).map(|p| &p.id).collect();
    let mut seen = BTreeSet::new();
    while let Some(id) = open.pop() {
        if seen.insert(id) {
            let normal = |d: &&NodeDep| d.dep_kinds.iter().any(|k| k.kind == DependencyKind::Normal);
            open.extend(nodes[id].deps.iter().filter(normal).map(|d| &d.pkg));
        }
    }
    seen.iter().map(|id| package[id].name.as_str()).collect()
}

#[test]
fn the_controller_is_embedded_without_links_threads_and_command_lines() {
    let metadata = MetadataCommand::new().exec().expect("cargo metadata runs");
    let controller = packages(&metadata, "nearl-controller");
    assert!(controller.contains("nearl-constraints") && controller.len() > 10, "{controller:?}");
    let found: Vec<_> = NOT_EMBEDDED.iter().filter(|library| controller.contains(**library)).collect();
    assert!(found.is_empty(), "nearl-controller builds {found:?}");
    let own = files(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../runtime/controller/src"));
    assert!(own.len() > 20, "{} files: this shows nothing", own.len());
    for file in own {
        let text = std::fs::read_to_string(&file).expect("a source file");
        assert!(!text.contains("std::thread"), "{} names threads", file.display());
    }
}

/// Packages that building the controller takes, itself included; 156 while it was a part of the runtime's crate.
const MOST_PACKAGES: usize = 78;

/// As `cargo tree -p nearl-controller -e normal` lists them, each version once.
#[test]
fn the_controller_is_built_from_few_packages() {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let tree = ["tree", "-p", "nearl-controller", "-e", "normal", "--prefix", "none", "--locked"];
    let output = Command::new(cargo).args(tree).current_dir(env!("CARGO_MANIFEST_DIR")).output();
    let output = output.expect("cargo tree runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).expect("names");
    let name_and_version = |line: &str| line.split(' ').take(2).collect::<Vec<_>>().join(" ");
    let packages: BTreeSet<_> = text.lines().map(name_and_version).collect();
    let found = packages.len();
    assert!((10..=MOST_PACKAGES).contains(&found), "{found} packages: which of them is new? {packages:?}");
}

#[test]
fn extension_module_is_not_built_by_default() {
    let manifest = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../Cargo.toml"))
        .expect("workspace manifest");
    let line = manifest.lines().find(|l| l.starts_with("default-members")).expect("default-members");
    assert!(!line.contains("python"), "bare cargo commands must not need a Python: {line}");
}

/// Room of `nearl-runtime` -> the rooms that it may not name: what lies below both is `clock`, `grid`, `stop`, `thread` and `percentiles`.
const ROOMS: &[(&str, &[&str])] = &[
    ("link", &["rt", "log", "cli", "doctor", "tunnel"]),
    ("rt", &["cli", "doctor", "tunnel"]),
    ("log", &["cli", "doctor", "tunnel"]),
];

/// The files of a room, those of its inner rooms too.
fn files(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).expect("a room").map(|entry| entry.expect("a file").path());
    entries.flat_map(|path| if path.is_dir() { files(&path) } else { vec![path] }).collect()
}

#[test]
fn no_room_of_the_runtime_imports_one_above_it() {
    for (room, above) in ROOMS {
        let folder = format!("{}/../runtime/src/{room}", env!("CARGO_MANIFEST_DIR"));
        for file in files(Path::new(&folder)) {
            let text = std::fs::read_to_string(&file).expect("a source file");
            for (number, line) in
                text.lines().enumerate().filter(|(_, line)| !line.trim_start().starts_with("//"))
            {
                let named = above.iter().find(|other| line.contains(&format!("crate::{other}::")));
                assert!(named.is_none(), "{}:{}: {line}", file.display(), number + 1);
            }
        }
    }
}

/// Programs of tests beside the one that a crate has: why is said in the first comment of each, and in CONTRIBUTING.md.
const MORE_TESTS: &[(&str, &[&str])] =
    &[("nearl-runtime", &["suite", "clock"]), ("nearl-tests", &["suite", "programs", "fuzz"])];

/// Each program of tests is linked anew after every change of what is below it.
#[test]
fn tests_of_a_crate_are_one_program_where_nothing_forbids_it() {
    let metadata = MetadataCommand::new().no_deps().exec().expect("cargo metadata runs");
    for package in &metadata.packages {
        let tests: BTreeSet<&str> =
            package.targets.iter().filter(|t| t.is_test()).map(|t| t.name.as_str()).collect();
        match MORE_TESTS.iter().find(|(name, _)| *name == package.name.as_str()) {
            Some((name, most)) => assert_eq!(tests, most.iter().copied().collect(), "{name}"),
            None => assert!(tests.len() <= 1, "{} has {tests:?}: make them modules of one", package.name),
        }
    }
}

/// Widest line of a page or a source file [characters].
const WIDTH: usize = 160;

/// Tables and logs that programs of `results` wrote.
const AS_THEY_ARE: [&str; 6] =
    ["table.md", "log.md", "compare-panda.md", "compare-z1.md", "proposer.md", "franka.md"];

/// Pages and sources below a folder, none of what is built or installed.
fn written(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("a file").path()) {
        let name = entry.file_name().expect("a name").to_string_lossy().into_owned();
        let is_built = matches!(&name[..], "target" | "runs" | "demo") || name.starts_with('.');
        if is_built || AS_THEY_ARE.contains(&&name[..]) || entry.is_symlink() {
            continue;
        }
        if entry.is_dir() {
            written(&entry, found);
        } else if ["md", "rs", "py", "pyi", "sh", "c", "h", "cpp", "hpp"]
            .iter()
            .any(|end| name.ends_with(&format!(".{end}")))
        {
            found.push(entry);
        }
    }
}

#[test]
fn pages_and_sources_keep_their_width() {
    let mut files = Vec::new();
    written(&Path::new(env!("CARGO_MANIFEST_DIR")).join(".."), &mut files);
    let wide: Vec<String> = files
        .iter()
        .flat_map(|file| {
            let text = std::fs::read_to_string(file).expect("text");
            let wide = text.lines().enumerate().filter(|(_, line)| line.chars().count() > WIDTH);
            wide.map(|(number, _)| format!("{}:{}", file.display(), number + 1)).collect::<Vec<_>>()
        })
        .collect();
    assert!(files.len() > 500, "{} files: this shows nothing", files.len());
    assert!(wide.is_empty(), "wider than {WIDTH}: break the line, or turn the table: {}", wide.join(", "));
}
