//! Files made to take all the memory or all the time: each is refused by name, within a limit of both.

use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::Command;

use crate::common::*;

/// Address space of a command [bytes], and time of a processor [s]: far more than an ordinary file needs (the control below), far less than
/// the bombs ask for.
const LIMITS: (u64, u64) = (2 << 30, 30);

/// Runs `nearl` within [`LIMITS`]: exit code (none where a limit ended it), output, errors.
fn limited(folder: &Path, arguments: &[&str], input: Option<&Path>) -> (Option<i32>, String, String) {
    let mut command = Command::new(program("nearl"));
    command.args(arguments).current_dir(folder).env("RUST_BACKTRACE", "0");
    // SAFETY: only system calls between fork and exec.
    unsafe {
        command.pre_exec(|| {
            let set = |what, most| {
                let limit = libc::rlimit { rlim_cur: most, rlim_max: most };
                match libc::setrlimit(what, &raw const limit) {
                    0 => Ok(()),
                    _ => Err(std::io::Error::last_os_error()),
                }
            };
            set(libc::RLIMIT_AS, LIMITS.0)?;
            set(libc::RLIMIT_CPU, LIMITS.1)
        });
    }
    let input =
        input.map_or(std::process::Stdio::null(), |file| std::fs::File::open(file).expect("input").into());
    let output = Process::start_with(&mut command, input).output();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.code(), text(&output.stdout), text(&output.stderr))
}

/// The exit code of a refusal and one short sentence with `words`.
fn refused(folder: &Path, arguments: &[&str], input: Option<&Path>, words: &str) {
    let (code, _, error) = limited(folder, arguments, input);
    let shown: String = error.chars().take(600).collect();
    // `nearl verify` has 1 for what does not hold.
    let wanted = if arguments[0] == "verify" { 2 } else { 1 };
    assert_eq!(code, Some(wanted), "{arguments:?}: {shown}");
    assert!(error.starts_with("nearl: ") && error.trim_end().lines().count() == 1, "{arguments:?}: {shown}");
    assert!(error.contains(words), "{arguments:?}: '{words}' is not in: {shown}");
    assert!(error.len() < 4000, "{arguments:?}: a message of {} bytes", error.len());
}

fn fixture(name: &str) -> String {
    std::fs::read_to_string(repository().join("tests/fixtures").join(name)).expect(name)
}

/// A folder with the two-link arm and its task.
fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("folder");
    for name in ["two_link.xml", "two_link.toml"] {
        std::fs::write(folder.path().join(name), fixture(name)).expect(name);
    }
    folder
}

/// Without this, every refusal below could be the limits' own.
#[test]
fn an_ordinary_robot_task_and_line_are_within_the_limits() {
    let folder = folder();
    for arguments in
        [&["robot", "two_link.xml"][..], &["train", "two_link.toml", "--steps", "64", "--out", "run"]]
    {
        let (code, out, error) = limited(folder.path(), arguments, None);
        assert_eq!(code, Some(0), "{arguments:?}: {out}{error}");
    }
    let line = r#"{"q":[0,0],"v":[0,0],"q_proposal":[9,9],"v_proposal":[0,0]}"#;
    let file = folder.path().join("line");
    std::fs::write(&file, line).expect("line");
    let (code, out, error) = limited(folder.path(), &["project", "two_link.toml"], Some(&file));
    assert_eq!(code, Some(0), "{out}{error}");
}

#[test]
fn robots_that_ask_for_too_much_are_refused_by_element_and_number() {
    let folder = folder();
    let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).expect(name);
    let arm = fixture("two_link.xml");
    let with = |inside: &str| arm.replace("<worldbody>", &format!("{inside}<worldbody>"));
    for (text, words) in [
        (with("<size nuserdata=\"2000000000\"/>"), "nuserdata asks for 2000000000 numbers"),
        (with("<size memory=\"900G\"/>"), "memory asks for"),
        (
            with("<asset><hfield name=\"h\" nrow=\"100000\" ncol=\"100000\" size=\"1 1 1 1\"/></asset>"),
            "nrow x ncol asks for 10000000000 numbers",
        ),
        (
            with("<asset><texture type=\"2d\" builtin=\"flat\" width=\"100000\" height=\"100000\"/></asset>"),
            "width x height asks for",
        ),
        (with("<custom><numeric name=\"n\" size=\"2000000000\"/></custom>"), "size asks for 2000000000"),
        (
            arm.replace(
                "</worldbody>",
                "<replicate count=\"100000\" offset=\"1 0 0\">\
                 <replicate count=\"1000\" offset=\"0 1 0\"><geom size=\"1\"/></replicate></replicate></worldbody>",
            ),
            "<replicate> makes",
        ),
        (
            arm.replace("</worldbody>", &format!("{}{}</worldbody>", "<body>".repeat(20_000), "</body>".repeat(20_000))),
            "within more than 400",
        ),
        (
            arm.replace(
                "</worldbody>",
                &format!("{}</worldbody>", "<body><joint type=\"slide\"/><geom size=\"1\"/></body>".repeat(20_000)),
            ),
            "joints of the file",
        ),
        (arm.replace("<worldbody>", "<include file=\"part.xml\"/><worldbody>"), "nuserdata asks for"),
    ] {
        write("part.xml", "<mujocoinclude><size nuserdata=\"2000000000\"/></mujocoinclude>");
        write("bomb.xml", &text);
        refused(folder.path(), &["robot", "bomb.xml"], None, words);
        write("bomb.toml", &fixture("two_link.toml").replace("two_link.xml", "bomb.xml"));
        refused(folder.path(), &["train", "bomb.toml", "--out", "run"], None, words);
    }
    let urdf = |n: usize, is_chain: bool| {
        let mut text = "<robot name=\"x\"><link name=\"l0\"/>".to_owned();
        for i in 1..n {
            let parent = if is_chain { i - 1 } else { 0 };
            text += &format!(
                "<link name=\"l{i}\"><inertial><mass value=\"1\"/><inertia ixx=\"1\" ixy=\"0\" ixz=\"0\" iyy=\"1\" iyz=\"0\" izz=\"1\"/></inertial></link>\
                 <joint name=\"j{i}\" type=\"revolute\"><parent link=\"l{parent}\"/><child link=\"l{i}\"/><axis xyz=\"0 0 1\"/>\
                 <limit lower=\"-1\" upper=\"1\" velocity=\"1\" effort=\"10\"/></joint>"
            );
        }
        text + "</robot>"
    };
    let attributes: String = (0..500_000).map(|i| format!("a{i}=\"1\" ")).collect();
    for (text, words) in [
        (urdf(20_000, true), "19999 dofs, more than the 500"),
        (urdf(20_000, false), "19999 dofs, more than the 500"),
        ("<a>".repeat(500_000), "not a usable URDF file"),
        (format!("<robot name=\"x\" {attributes}><link name=\"a\"/></robot>"), "more than 4096"),
        (format!("<robot name=\"{}\"/>", "x".repeat(17 << 20)), "more than the limit of 16777216"),
    ] {
        write("bomb.urdf", &text);
        refused(folder.path(), &["robot", "bomb.urdf"], None, words);
    }
}

#[test]
fn tasks_that_take_too_much_to_read_are_refused_by_key_and_number() {
    let folder = folder();
    let task = fixture("two_link.toml");
    let term = "still = \"-v.elbow^2\"";
    assert!(task.contains(term) && task.contains("torque = {}"));
    let rewarded = |text: &str| task.replace(term, text);
    let row = |i: usize| format!("{{ name = \"r{i}\", terms = {{ \"v.elbow\" = 1.0 }}, upper = 5.0 }}");
    let rows: Vec<String> = (0..5_000).map(row).collect();
    let many: Vec<String> = (0..20_000).map(|i| format!("t{i} = \"v.elbow\"")).collect();
    for (text, words) in [
        (rewarded(&format!("still = \"{}\"", vec!["v.elbow"; 90_000].join(" + "))), "reward.still"),
        (
            rewarded(&format!("still = \"{}v.elbow{}\"", "(".repeat(200_000), ")".repeat(200_000))),
            "reward.still",
        ),
        (rewarded(&format!("still = \"{}v.elbow\"", "-".repeat(200_000))), "reward.still"),
        (rewarded(&format!("still = \"{}\"", "v".repeat(1_000_000))), "reward.still"),
        (rewarded(&many.join("\n")), "20000 terms, more than the 1000"),
        (
            task.replace("torque = {}", &format!("torque = {{}}\nrows = [{}]", rows.join(","))),
            "rows has 5000 entries",
        ),
        (format!("{task}\n[metrics]\na = {}{}", "[".repeat(200_000), "]".repeat(200_000)), "recurs"),
        (format!("{task}\n{} = 1", vec!["a"; 200_000].join(".")), "recursion limit"),
    ] {
        assert!(text.len() <= MOST_OF_A_TASK, "'{words}' is not what would refuse it");
        std::fs::write(folder.path().join("bomb.toml"), text).expect("task file");
        refused(folder.path(), &["train", "bomb.toml", "--out", "run"], None, words);
    }
}

/// Largest task file [bytes].
const MOST_OF_A_TASK: usize = 1 << 20;

/// By every command that reads one; a comment of its own length is as long as a file may be.
#[test]
fn task_files_beyond_their_size_are_refused_by_name_before_they_are_parsed() {
    let folder = folder();
    let at = |name: &str| folder.path().join(name);
    let task = fixture("two_link.toml") + "\n#";
    let longest = format!("{task}{}", "x".repeat(MOST_OF_A_TASK - task.len()));
    std::fs::write(at("longest.toml"), &longest).expect("task file");
    let arguments = ["train", "longest.toml", "--steps", "64", "--out", "longest"];
    let (code, out, error) = limited(folder.path(), &arguments, None);
    assert_eq!(code, Some(0), "{out}{error}");
    // Not a task at all: what is too long is not looked at.
    std::fs::write(at("beyond.toml"), "=".repeat(MOST_OF_A_TASK + 1)).expect("task file");
    let panda = panda();
    let panda = panda.to_str().expect("UTF-8");
    let commands: &[&[&str]] = &[
        &["train", "beyond.toml", "--out", "run"],
        &["project", "beyond.toml"],
        &["run", panda, "--plant", "nobody", "--limits", "beyond.toml"],
        &["limits", "nobody", "--file", "beyond.toml"],
    ];
    for arguments in commands {
        refused(folder.path(), arguments, None, "beyond.toml");
        refused(folder.path(), arguments, None, "it has 1048577 bytes, more than the limit of 1048576");
    }
}

#[test]
fn lines_and_lists_without_an_end_are_refused_by_their_number() {
    let folder = folder();
    let at = |name: &str| folder.path().join(name);
    std::fs::write(at("endless"), vec![b'['; 64 << 20]).expect("file");
    std::fs::write(at("nested"), "[".repeat(500_000)).expect("file");
    refused(folder.path(), &["project", "two_link.toml"], Some(&at("endless")), "line 1: it is longer than");
    refused(
        folder.path(),
        &["project", "two_link.toml"],
        Some(Path::new("/dev/zero")),
        "line 1: it is longer than",
    );
    refused(folder.path(), &["project", "two_link.toml"], Some(&at("nested")), "line 1");
    let panda = panda();
    let panda = panda.to_str().expect("UTF-8");
    std::fs::write(at("deep.json"), format!("{{\"faults\":{}", "[".repeat(500_000))).expect("file");
    std::fs::write(at("deep.toml"), format!("[constraints]\na = {}", "[".repeat(500_000))).expect("file");
    refused(folder.path(), &["run", panda, "--plant", "nobody", "--faults", "deep.json"], None, "deep.json");
    refused(folder.path(), &["run", panda, "--plant", "nobody", "--limits", "deep.toml"], None, "deep.toml");
}

/// Everything that is opened by a path, given a pipe without a writer, and a file without an end.
#[test]
fn pipes_and_endless_files_are_refused_at_once_by_every_command() {
    let folder = folder();
    let fifo = Command::new("mkfifo").arg(folder.path().join("fifo")).status().expect("mkfifo");
    assert!(fifo.success());
    std::fs::copy(repository().join("examples/robots/panda/panda.urdf"), folder.path().join("panda.urdf"))
        .expect("copy");
    let panda = panda();
    let panda = panda.to_str().expect("UTF-8");
    for odd in ["fifo", "/dev/zero"] {
        let commands: &[&[&str]] = &[
            &["robot", odd],
            &["project", odd],
            &["train", odd],
            &["train", "Panda-reach", "--algo", "bc", "--demos", odd, "--out", "demos"],
            &["eval", odd],
            &["run", panda, "--plant", "nobody", "--faults", odd],
            &["run", panda, "--plant", "nobody", "--limits", odd],
            &["run", odd, "--plant", "nobody"],
            &["serve", odd, "--name", "nobody"],
            &["replay", odd],
            &["verify", odd],
            &["export", odd, "--out", "x.onnx"],
            &["import", odd, "--robot", "panda.urdf", "--out", "x"],
            &["blank", odd, "--out", "x"],
        ];
        for arguments in commands {
            refused(folder.path(), arguments, None, "regular file");
        }
    }
}

/// A name that leads elsewhere is no file to be replaced: a link stays and its file is written, and what is no file is refused.
#[test]
fn links_are_written_through_and_pipes_are_not_replaced() {
    let folder = folder();
    let place = |name: &str| folder.path().join(name);
    let is_pipe = |name: &str| {
        use std::os::unix::fs::FileTypeExt;
        std::fs::symlink_metadata(place(name)).expect("metadata").file_type().is_fifo()
    };
    assert!(Command::new("mkfifo").arg(place("pipe")).status().expect("mkfifo").success());
    std::fs::write(place("real"), "old").expect("real");
    std::os::unix::fs::symlink("real", place("link")).expect("link");
    let panda = panda();
    let panda = panda.to_str().expect("UTF-8");
    for arguments in [["export", panda, "--out"], ["blank", "two_link.toml", "--out"]] {
        let with = |out: &'static str| [&arguments[..], &[out]].concat();
        refused(folder.path(), &with("pipe"), None, "a pipe, and no file; give another path");
        assert!(is_pipe("pipe"), "{arguments:?}: the pipe is gone");
        refused(folder.path(), &with("."), None, "a folder");
        std::fs::write(place("real"), "old").expect("real");
        let (code, _, error) = limited(folder.path(), &with("link"), None);
        assert_eq!(code, Some(0), "{arguments:?}: {error}");
        assert!(std::fs::symlink_metadata(place("link")).expect("link").is_symlink(), "{arguments:?}");
        assert!(
            std::fs::read(place("real")).expect("real").len() > 100,
            "{arguments:?}: the file is the old one"
        );
    }
}
