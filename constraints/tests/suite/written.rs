//! What is written from the registry: the classes of Python, and the list of kinds on the page about limits. A test fails where they are old;
//! `NEARL_WRITE=1 cargo test --release --locked -p nearl-constraints --test suite written` writes them anew.

use nearl_constraints::Kind;
use nearl_constraints::limit::{Argument, REGISTRY, RegisteredLimit};
use std::fmt::Write;
use std::path::Path;

const COMMAND: &str = "NEARL_WRITE=1 cargo test --release --locked -p nearl-constraints --test suite written";
const WIDTH: usize = 140;

/// `text` in lines of at most [`WIDTH`] characters, each after `before`.
fn wrapped(text: &str, before: &str) -> String {
    let mut lines = vec![String::new()];
    for word in text.split(' ') {
        let line = lines.last_mut().unwrap();
        if !line.is_empty() && before.len() + line.chars().count() + 1 + word.chars().count() > WIDTH {
            lines.push(word.to_string());
        } else {
            line.push_str(if line.is_empty() { "" } else { " " });
            line.push_str(word);
        }
    }
    lines.iter().map(|line| format!("{before}{line}")).collect::<Vec<_>>().join("\n")
}

fn parameter(argument: &Argument) -> String {
    let (name, takes) = (argument.name, argument.takes.python());
    match argument.default {
        None => format!("{name}: {takes}"),
        Some("None") => format!("{name}: {takes} | None = None"),
        Some(default) => format!("{name}: {takes} = {default}"),
    }
}

fn class(entry: &RegisteredLimit) -> String {
    let (about, name) = (entry.about, entry.name);
    let mut parameters = vec!["cls".to_string(), "model: Model".to_string()];
    let mut star = false;
    for argument in about.arguments {
        if argument.by_name && !star {
            parameters.push("*".into());
        }
        star |= argument.by_name;
        parameters.push(parameter(argument));
    }
    let given = about.arguments.iter().map(|a| format!("            \"{0}\": {0},\n", a.name));
    let class = about.class;
    let doc = wrapped(&format!("\"\"\"{}", about.promise), "    ");
    format!(
        "@final\nclass {class}(Limit):\n{doc}\n\n    In a task file:\n\n        {}\n    \"\"\"\n\n    __slots__ = ()\n\n    def __new__(\n        {},\n    ) \
         -> {class}:\n        settings = {{\n{}        }}\n        return super().__new__(cls, model, \"{name}\", settings)\n",
        about.example,
        parameters.join(",\n        "),
        given.collect::<String>(),
    )
}

fn python() -> String {
    let mut classes: Vec<&RegisteredLimit> = REGISTRY.iter().collect();
    classes.sort_by_key(|entry| entry.about.class);
    let names: String = classes.iter().map(|entry| format!("    \"{}\",\n", entry.about.class)).collect();
    let kinds: String = Kind::ALL.iter().map(|kind| format!("    \"{}\",\n", kind.name())).collect();
    let bodies: Vec<String> = classes.into_iter().map(class).collect();
    format!(
        "\"\"\"The limits that a projector is built from.\n\nWritten from the registry of limits by\n`{COMMAND}`;\na test fails when this file is \
         old.\n\"\"\"\n\nfrom __future__ import annotations\n\nfrom collections.abc import Mapping, Sequence\nfrom typing import Any, Literal, final\n\n\
         from nearl._core import Limit, Model\n\n__all__ = [\n{names}]\n\n# One number for all joints, numbers by joint, or one for each dof.\n\
         PerJoint = float | Mapping[str, float] | Sequence[float]\n\n# What the rows of a ledger are called.\nRowKind = Literal[\n{kinds}]\n\n\n{}",
        bodies.join("\n\n")
    )
}

const BEGIN: &str = "<!-- kinds of limits: begin -->\n";
const END: &str = "<!-- kinds of limits: end -->\n";

fn kinds() -> String {
    let mut text = "| kind | Python | form | margin |\n|---|---|---|---|\n".to_string();
    for RegisteredLimit { name, about, .. } in REGISTRY {
        writeln!(text, "| `{name}` | `{}` | {} | {} |", about.class, about.form.name(), about.margin)
            .unwrap();
    }
    let lines = REGISTRY.iter().map(|e| format!("{}\n{}\n", wrapped(e.about.promise, "# "), e.about.example));
    format!("{text}\n```toml\n{}```\n", lines.collect::<Vec<_>>().join("\n"))
}

/// Compares `text` with the file, or writes it there.
fn hold(path: &Path, text: &str) {
    if std::env::var_os("NEARL_WRITE").is_some() {
        std::fs::write(path, text).unwrap();
    }
    let there = std::fs::read_to_string(path).unwrap();
    assert!(there == text, "{} is old; write it anew: {COMMAND}", path.display());
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap()
}

#[test]
fn the_classes_of_python_are_those_of_the_registry() {
    hold(&root().join("python/nearl/limits.py"), &python());
}

#[test]
fn the_page_about_limits_lists_the_kinds_of_the_registry() {
    let path = root().join("docs/LIMITS.md");
    let page = std::fs::read_to_string(&path).unwrap();
    let (before, rest) = page.split_once(BEGIN).expect(BEGIN);
    let (_, after) = rest.split_once(END).expect(END);
    hold(&path, &format!("{before}{BEGIN}\n{}\n{END}{after}", kinds()));
}

#[test]
fn numbers_of_kinds_stand_in_logs_and_stay() {
    let names: Vec<&str> = Kind::ALL.iter().map(|kind| kind.name()).collect();
    let written = "position velocity acceleration viability torque jerk torque_speed torque_rate frame frame_speed energy collision user locked \
                   velocity_profile";
    assert_eq!(names[..15].join(" "), written);
    assert!(Kind::ALL.iter().enumerate().all(|(number, kind)| *kind as usize == number));
}
