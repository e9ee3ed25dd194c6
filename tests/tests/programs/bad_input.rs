//! Bad input to the real program: one sentence that names the thing, an exit code that is not 0, never a panic.

use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};

use crate::common::*;
use nearl_runtime::Snapshot;
use nearl_runtime::link::{RobotName, remove_files};

/// Runs `nearl` in `folder` with `input`: exit code, standard output, standard error.
fn nearl(folder: &Path, arguments: &[&str], input: &[u8]) -> (Option<i32>, String, String) {
    let mut command = Command::new(program("nearl"));
    let file = folder.join("input");
    std::fs::write(&file, input).expect("input");
    command.args(arguments).current_dir(folder);
    let output =
        Process::start_with(&mut command, std::fs::File::open(&file).expect("input").into()).output();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.code(), text(&output.stdout), text(&output.stderr))
}

/// Exit code 1 and one line on standard error that contains every one of `says`.
fn assert_refused(folder: &Path, arguments: &[&str], input: &[u8], says: &[&str]) {
    let (code, _, error) = nearl(folder, arguments, input);
    assert_eq!(code, Some(1), "{arguments:?}: {error}");
    assert!(!error.contains("panicked"), "{arguments:?}: {error}");
    assert_eq!(error.trim_end().lines().count(), 1, "{arguments:?}: {error}");
    assert!(error.starts_with("nearl: "), "{arguments:?}: {error}");
    for part in says {
        assert!(error.contains(part), "{arguments:?}: '{part}' is not in: {error}");
    }
}

fn folder() -> tempfile::TempDir {
    tempfile::tempdir().expect("folder")
}

/// The bundled task file with one text replaced by another.
fn changed(task: &str, from: &str, to: &str) -> String {
    let file = repository().join("examples/tasks").join(format!("{task}.toml"));
    let text = std::fs::read_to_string(file).expect("task file");
    assert!(text.contains(from), "{task} has no '{from}'");
    text.replace(from, to)
}

/// Bundled task, text in it, its replacement, and what the message must say about the file.
const FILES: &[(&str, &str, &str, &[&str])] = &[
    ("Panda-reach", "velocity = {", "velocty = {", &["t.toml:23", "velocty", "did you mean 'velocity'"]),
    (
        "Panda-reach",
        "[constraints]",
        "[constrants]",
        &["t.toml:", "constrants", "did you mean 'constraints'"],
    ),
    (
        "Panda-reach",
        "dt = 0.001\npolicy",
        "dt = \"fast\"\npolicy",
        &["t.toml:9", "time.dt", "it is \"fast\"; give a number"],
    ),
    (
        "Panda-reach",
        "[state]",
        "[state]\ncontrollable = [\n \"panda_joint1\",\n 2]",
        &["t.toml:16 [state.controllable[1]]", "it is 2; give a text in quotes"],
    ),
    ("Panda-reach", "name = \"Panda-reach\"", "", &["t.toml", "`name` is missing; add it"]),
    ("Panda-reach", "name = \"Panda-reach\"", "name = ", &["t.toml:3"]),
    ("Panda-reach", "[time]", "[model]", &["t.toml:8", "duplicate key"]),
    ("Panda-reach", "[time]", "mjcf = \"a.xml\"\n[time]", &["t.toml", "exactly one of 'urdf' and 'mjcf'"]),
    ("Panda-reach", "urdf = \"panda.urdf\"", "", &["t.toml", "exactly one of 'urdf' and 'mjcf'"]),
    (
        "Panda-reach",
        "panda.urdf",
        "nowhere.urdf",
        &["nowhere.urdf", "No such file", "relative to the task file"],
    ),
    ("Panda-reach", "dt = 0.001\npolicy", "dt = 0\npolicy", &["t.toml", "time.dt", "0 s"]),
    ("Panda-reach", "dt = 0.001\npolicy", "dt = -0.001\npolicy", &["t.toml", "time.dt", "-0.001 s"]),
    ("Panda-reach", "dt = 0.001\npolicy", "dt = nan\npolicy", &["t.toml", "time.dt", "NaN s"]),
    (
        "Panda-reach",
        "limit = 10.0",
        "limit = { panda_joint2 = inf }",
        &[
            "t.toml:24 [constraints.acceleration.limit.panda_joint2]: inf is not finite",
            "give a finite number",
        ],
    ),
    (
        "Panda-reach",
        "[state]",
        "[policy]\njoints = [\"panda_joint1\"]\npose = [\n    nan]\n[state]",
        &["t.toml:16 [policy.pose[0]]: NaN is not finite"],
    ),
    ("Panda-reach", "sim_dt = 0.001", "sim_dt = 0.0007", &["time.sim_dt", "whole number", "0.0007 s"]),
    (
        "Panda-reach",
        "sim_dt = 0.001",
        "sim_dt = 5e-7",
        &["time.dt", "more than 1000 physics steps of 0.0000005 s"],
    ),
    ("HalfCheetah-v5", "[state]", "[time]\ndt = 0.1\n[state]", &["time.dt", "0.1 s", "simulates 0.05 s"]),
    ("Ant-v5", "[state]", "[time]\ndt = 0.04\n[state]", &["time.dt", "0.04 s", "simulates 0.05 s"]),
    (
        "HalfCheetah-v5",
        "name = \"HalfCheetah-v5\"",
        "name = \"mine\"",
        &["time.dt", "the control period is not stated", "only a task of a native environment"],
    ),
    ("Panda-reach", "sim_dt = 0.001", "sim_dt = 0.0005", &["time.sim_dt", "0.0005 s", "simulates 0.001 s"]),
    ("Panda-reach", "policy_every = 20", "policy_every = 0", &["time.policy_every", "0 ticks"]),
    (
        "HalfCheetah-v5",
        "[state]",
        "[time]\npolicy_every = 2\n[state]",
        &["time.policy_every", "2 ticks", "use 1"],
    ),
    (
        "HalfCheetah-v5",
        "\"bthigh\"",
        "\"bthig\"",
        &["state.controllable", "'bthig'", "did you mean 'bthigh'"],
    ),
    (
        "Panda-reach",
        "velocity = { scale = 0.9 }",
        "velocity = { limit = -1.0 }",
        &["t.toml:23 [constraints.velocity]: ", "velocity limit is -1, but must be above 0 rad/s or m/s"],
    ),
    (
        "Panda-reach",
        "velocity = { scale = 0.9 }",
        "velocity = [0.5, 0.2]",
        &["[constraints.velocity]", "it is a list", "limit = { shoulder = 2.0 }"],
    ),
    (
        "Panda-reach",
        "margin = 0.01",
        "margin = 5.0",
        &["leaves nothing of its range", "'panda_joint1'", "'panda_joint7'", "rad"],
    ),
    (
        "Panda-reach",
        "name = \"Panda-reach\"",
        "name = \"../escape\"\nenv = \"Panda-reach\"",
        &["t.toml [name]", "'../escape'", "without '/'"],
    ),
    (
        "Panda-reach",
        "[state]",
        "[state]\ncontrollable = []",
        &["no joint is controllable", "'position' would hold for none", "state.controllable"],
    ),
];

#[test]
fn a_bad_task_file_is_refused_with_file_line_and_key() {
    let folder = folder();
    for (task, from, to, says) in FILES {
        std::fs::write(folder.path().join("t.toml"), changed(task, from, to)).expect("task file");
        assert_refused(folder.path(), &["project", "t.toml"], b"", says);
    }
    std::fs::write(folder.path().join("t.toml"), b"\xff\xfe").expect("task file");
    assert_refused(folder.path(), &["project", "t.toml"], b"", &["t.toml", "UTF-8"]);
    assert_refused(folder.path(), &["project", "missing.toml"], b"", &["missing.toml", "No such file"]);
    std::fs::create_dir(folder.path().join("folder.toml")).expect("folder");
    assert_refused(folder.path(), &["project", "folder.toml"], b"", &["folder.toml", "directory"]);
}

#[test]
fn a_robot_file_that_is_refused_is_named() {
    let folder = folder();
    let joint = "<joint name=\"hip\" range=\"-1 1\" limited=\"true\"/>";
    let robot = format!("<mujoco><worldbody><body>{joint}<geom size=\".1\"/></body></worldbody></mujoco>");
    let step = "<mujoco><option timestep=\"nan\"/>";
    for (from, to, says) in [
        ("</body>", "", &["robot.xml: MuJoCo cannot load the robot file: "][..]),
        ("-1 1", "-inf inf", &["robot.xml holds impossible numbers: joint 'hip' has a range from -inf"]),
        ("<mujoco>", step, &["robot.xml: <option timestep> of the robot file is NaN s", "above 0"]),
    ] {
        assert!(robot.contains(from));
        std::fs::write(folder.path().join("robot.xml"), robot.replace(from, to)).expect("robot");
        assert_refused(folder.path(), &["robot", "robot.xml"], b"", says);
    }
}

/// Without an environment there is nothing to train on, but a robot and limits are enough to project.
#[test]
fn an_environment_is_needed_to_train_and_its_robot_is_its_own() {
    let folder = folder();
    let write = |from: &str, to: &str| {
        std::fs::write(folder.path().join("t.toml"), changed("Panda-reach", from, to)).expect("task file");
    };
    write("name = \"Panda-reach\"", "name = \"Panda-rech\"");
    assert_refused(folder.path(), &["train", "t.toml"], b"", &["Panda-rech", "did you mean 'Panda-reach'"]);
    let line = br#"{"q":[0,0,0,-1.5,0,1.5,0],"v":[0,0,0,0,0,0,0],"q_proposal":[9,0,0,-1.5,0,1.5,0],"v_proposal":[0,0,0,0,0,0,0]}"#;
    let (code, alone, error) = nearl(folder.path(), &["project", "t.toml"], line);
    assert_eq!(code, Some(0), "{error}");
    write("", "");
    let (_, with, _) = nearl(folder.path(), &["project", "t.toml"], line);
    let target = |text: &str| {
        let line: serde_json::Value = serde_json::from_str(text).expect("JSON");
        (line["q"].clone(), line["v"].clone(), line["active"].clone())
    };
    assert_eq!(target(&alone), target(&with));

    let robot =
        std::fs::read_to_string(repository().join("examples/robots/panda/panda.urdf")).expect("robot");
    let heavy = robot.replace("<mass value=\"", "<mass value=\"1");
    assert_ne!(heavy, robot);
    std::fs::write(folder.path().join("heavy.urdf"), heavy).expect("robot");
    write("panda.urdf", "heavy.urdf");
    let says = ["t.toml", "[model]", "'heavy.urdf' differs in its masses", "[reward]"];
    assert_refused(folder.path(), &["train", "t.toml"], b"", &says[1..]);
    write("urdf = \"panda.urdf\"", "urdf = \"ur5.urdf\"");
    let ur5 = repository().join("examples/robots/ur5/ur5.urdf");
    std::fs::copy(ur5, folder.path().join("ur5.urdf")).expect("robot");
    assert_refused(
        folder.path(),
        &["plant", "t.toml", "--name", "ur"],
        b"",
        &["differs in its joints", "shoulder_pan_joint"],
    );
}

/// The file above is good where it is not changed: without this, every refusal could have another cause.
#[test]
fn the_unchanged_task_file_projects() {
    let folder = folder();
    std::fs::write(folder.path().join("t.toml"), changed("Panda-reach", "", "")).expect("task file");
    let line = br#"{"q":[0,0,0,-1.5,0,1.5,0],"v":[0,0,0,0,0,0,0],"q_proposal":[9,0,0,-1.5,0,1.5,0],"v_proposal":[0,0,0,0,0,0,0]}"#;
    let (code, out, error) = nearl(folder.path(), &["project", "t.toml"], line);
    assert_eq!(code, Some(0), "{error}");
    let target: serde_json::Value = serde_json::from_str(&out).expect("JSON");
    assert_eq!(target["target_violations"], 0, "{target}");
    assert_eq!((&target["status"], &target["rung"]), (&"clamped".into(), &"closed form".into()), "{target}");
    assert!(target["raw_violations"].as_u64() > Some(0), "{target}");
}

/// Arguments and what the message must say.
const COMMANDS: &[(&[&str], &[&str])] = &[
    (&["train", "HalfCheeta-v5"], &["'HalfCheeta-v5'", "did you mean 'HalfCheetah-v5'"]),
    (
        &["train", "Hopper-v5", "--algo", "pid2-bi"],
        &["no algorithm 'pid2-bi'", "did you mean 'pid2-ib'?", "pid2-gan"],
    ),
    (&["bench", "train", "Hopper-v5", "--algo", "sac"], &["no algorithm 'sac'; give one of ppo"]),
    (
        &["train", "Hopper-v5", "--set", "train.ppo.batch_size=100"],
        &["train.ppo.batch_size", "100", "multiple of 32"],
    ),
    (
        &["train", "Hopper-v5", "--set", "train.ppo.batch_siz=64"],
        &["train.ppo.batch_siz", "did you mean 'batch_size'"],
    ),
    (&["train", "Hopper-v5", "--set", "train.n_envs=0"], &["train.n_envs", "at least 1"]),
    (&["train", "Hopper-v5", "--set", "train.gamma=1.5"], &["train.gamma", "1.5", "[0, 1]"]),
    (
        &["train", "Hopper-v5", "--set", "train.ppo.clip_range=-0.2"],
        &["train.ppo.clip_range", "-0.2", "above 0"],
    ),
    (&["train", "Hopper-v5", "--set", "nonsense"], &["--set nonsense", "key=value"]),
    (&["train", "Hopper-v5", "--set", "=3"], &["--set =3", "the key is empty"]),
    (&["train", "Hopper-v5", "--set", "time.dt.x=3"], &["--set time.dt.x=3", "'dt' is a value"]),
    (&["train", "Hopper-v5", "--set", "time.dx=3"], &["time.dx", "unknown field `dx`"]),
    (&["train", "Hopper-v5", "--set", "time.dt=fast"], &["time.dt", "\"fast\""]),
    (&["train", "Hopper-v5", "--out", "/proc/nowhere"], &["/proc/nowhere", "--out"]),
    (&["train", "Hopper-v5", "--out", "run"], &["'run' already holds a run", "--out"]),
    (&["eval", "empty"], &["'empty'", "checkpoints/final.safetensors"]),
    (&["eval", "nowhere"], &["'nowhere'", "does not exist"]),
    (&["eval", "fifo"], &["'fifo'", "regular file"]),
    (&["run", "nowhere", "--plant", "a"], &["'nowhere'", "No such file"]),
    (&["run", "empty", "--plant", "a"], &["'empty'", "not a regular file"]),
    (&["run", "fifo", "--plant", "a"], &["'fifo'", "not a regular file"]),
    (&["run", "link", "--plant", "a"], &["'link'", "not a regular file"]),
    (&["run", "panda", "--plant", "a/b"], &["`a/b`", "letters, digits"]),
    (&["plant", "Panda-reach", "--name", "a.b"], &["`a.b`", "letters, digits"]),
    (&["doctor", "fifo"], &["failed: snapshot"]),
    (
        &["plant", "Panda-reach", "--name", "a", "--faults", "lost.json"],
        &["'lost.json'", "fault 2 of the list happens between plant and loop", "take it out"],
    ),
    (&["run", "panda", "--plant", "a", "--faults", "lost.json"], &["'lost.json'", "fault 2 of the list"]),
];

/// The folder of a task file of one's own: the run's `task.toml` had taken its place.
#[test]
fn a_run_takes_no_file_s_place() {
    let folder = folder();
    let (task, out) = (folder.path().join("task.toml"), folder.path().display().to_string());
    let text = format!("# mine\n{}", changed("cart-pole", "", ""));
    std::fs::copy(repository().join("examples/tasks/cart-pole.xml"), folder.path().join("cart-pole.xml"))
        .expect("robot");
    std::fs::write(&task, &text).expect("task file");
    let train = ["train", "task.toml", "--algo", "ppo", "--steps", "2048", "--out", &out];
    assert_refused(
        folder.path(),
        &train,
        b"",
        &["task.toml' is there already", "give another folder with --out"],
    );
    assert_eq!(std::fs::read_to_string(&task).expect("text"), text);
    let comma = ["train", "task.toml", "--set", "reward={ \"a,b\" = \"1\" }", "--out", "run"];
    assert_refused(folder.path(), &comma, b"", &["[reward.a,b]", "no comma"]);
}

#[test]
fn bad_arguments_are_refused_with_their_name() {
    let folder = folder();
    let at = |name: &str| folder.path().join(name);
    std::fs::create_dir(at("empty")).expect("folder");
    std::fs::create_dir(at("run")).expect("folder");
    std::fs::write(at("run/metrics.csv"), "steps\n2048\n").expect("file");
    let faults =
        r#"{"faults": [{"tick": 9, "kind": {"fault": "freeze"}}, {"tick": 99, "kind": {"fault": "drop"}}]}"#;
    std::fs::write(at("lost.json"), faults).expect("file");
    std::fs::copy(panda(), at("panda")).expect("copy");
    std::os::unix::fs::symlink("panda", at("link")).expect("link");
    assert!(Command::new("mkfifo").arg(at("fifo")).status().expect("mkfifo").success());
    for (arguments, says) in COMMANDS {
        assert_refused(folder.path(), arguments, b"", says);
    }
}

#[test]
fn a_value_that_is_no_number_is_refused_before_anything_starts() {
    let folder = folder();
    for (arguments, says) in [
        (vec!["train", "Hopper-v5", "--steps", "many"], "'many' is not a number of steps"),
        (vec!["train", "Hopper-v5", "--steps", "-5"], "'-5' is not a number of steps"),
        (vec!["run", "x", "--plant", "a", "--seconds", "nan"], "'nan' is not a duration"),
        (vec!["run", "x", "--plant", "a", "--rate", "0"], "'0' is not a rate"),
        (vec!["plant", "Panda-reach", "--name", "a", "--seconds", "1e99"], "'1e99' is not a duration"),
        (vec!["demo", "--seconds", "nan"], "'nan' is not a duration"),
        (vec!["eval", "x", "--compare", "both"], "both"),
        (vec!["fly"], "'fly'"),
    ] {
        let (code, _, error) = nearl(folder.path(), &arguments, b"");
        assert_eq!(code, Some(2), "{arguments:?}: {error}");
        assert!(error.contains(says) && !error.contains("panicked"), "{arguments:?}: {error}");
    }
}

#[test]
fn a_runtime_without_a_plant_names_what_to_start_first() {
    let folder = folder();
    let name = format!("nobody-{}", std::process::id());
    let panda = panda();
    let arguments = ["run", panda.to_str().expect("UTF-8"), "--plant", &name];
    let says = format!("start `nearl plant TASK --name {name}` first");
    assert_refused(folder.path(), &arguments, b"", &[&says]);
    remove_files(&RobotName::new(&name).expect("name"));
}

#[test]
fn bad_lines_to_project_are_refused_with_their_number() {
    let folder = folder();
    for (input, says) in [
        (&b"hello"[..], "line 1: expected value"),
        (b"\n{\"q\": [0]}", "line 2: missing field"),
        (br#"{"q":[1],"v":[],"q_proposal":[],"v_proposal":[]}"#, "'q' has 1 numbers, but the robot has 7"),
        (br#"{"q":[1e999],"v":[],"q_proposal":[],"v_proposal":[]}"#, "line 1: number out of range"),
        (br#"{"q":[],"v":[],"q_proposal":[],"v_proposal":[],"w":[]}"#, "unknown field `w`"),
        (b"\xff\xfe\n", "line 1: stream did not contain valid UTF-8"),
    ] {
        assert_refused(folder.path(), &["project", "Panda-reach"], input, &["standard input", says]);
    }
}

#[test]
fn a_damaged_snapshot_is_refused_whatever_the_damage() {
    let good = std::fs::read(panda()).expect("snapshot");
    let refuse = |bytes: &[u8], what: &str| {
        let error = match Snapshot::from_bytes(bytes) {
            Ok(_) => panic!("{what}: accepted"),
            Err(error) => error.to_string(),
        };
        assert_eq!(error.lines().count(), 1, "{what}: {error}");
    };
    for length in (0..good.len()).step_by(61).chain([1, 7, 8, 9, good.len() - 1]) {
        refuse(&good[..length], &format!("{length} bytes"));
    }
    refuse(&[&good[..], b"x"].concat(), "a byte too many");
    for offset in (0..good.len()).step_by(53).chain(0..16) {
        for mask in [0x01, 0x80, 0xff] {
            let mut bytes = good.clone();
            bytes[offset] ^= mask;
            refuse(&bytes, &format!("byte {offset} ^ {mask}"));
        }
    }
    // The same through the program.
    let folder = folder();
    let last = good.len() - 1;
    let flipped = [&good[..last], &[good[last] ^ 1]].concat();
    let cases = [(&good[..0], "cut short"), (&good[..100], "cut short"), (&good[..last], "cut short")];
    for (bytes, says) in cases.into_iter().chain([(&flipped[..], "digest mismatch")]) {
        std::fs::write(folder.path().join("s"), bytes).expect("file");
        assert_refused(folder.path(), &["eval", "s"], b"", &["s: ", says]);
        assert_refused(folder.path(), &["run", "s", "--plant", "a"], b"", &["s: ", says]);
    }
}

#[test]
fn a_reader_that_closes_the_pipe_ends_the_program_quietly() {
    for arguments in [&["tasks"][..], &["bench", "loop", "--seconds", "0.1"], &["--help"]] {
        let mut command = Command::new(program("nearl"));
        let mut child =
            command.args(arguments).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("start");
        drop(child.stdout.take());
        let output = child.wait_with_output().expect("output");
        let error = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success() && !error.contains("panicked"), "{arguments:?}: {error}");
    }
    let full = std::fs::OpenOptions::new().write(true).open("/dev/full").expect("/dev/full");
    let output = Command::new(program("nearl")).arg("tasks").stdout(full).output().expect("output");
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.code() == Some(1) && error.contains("standard output"), "{error}");
}

/// What a plant of a snapshot may be changed in is what it simulates.
#[test]
fn a_plant_changes_nothing_of_a_snapshot_s_controller() {
    let (folder, panda) = (tempfile::tempdir().expect("folder"), panda());
    let arguments =
        ["plant", panda.to_str().expect("UTF-8"), "--set", "constraints.guard=true", "--name", "none"];
    assert_refused(
        folder.path(),
        &arguments,
        b"",
        &["constraints.guard=true", "what is simulated and no controller"],
    );
}

/// `ulimit -f` sends a signal, which ended the program without a word.
#[test]
fn a_file_beyond_the_largest_size_is_named() {
    let folder = tempfile::tempdir().expect("folder");
    let line = format!("ulimit -f 1; exec {} export \"$1\" --out policy.onnx", program("nearl").display());
    let mut command = Command::new("sh");
    let output =
        command.args(["-c", &line, "sh"]).arg(panda()).current_dir(&folder).output().expect("output");
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(
        output.status.code() == Some(1) && error.contains("policy.onnx") && error.contains("too large"),
        "{error}"
    );
    assert!(!folder.path().join("policy.onnx").exists());
}

/// The doctor's lines: `ok`, `warn` or `fail`, then what was looked at.
fn doctor(arguments: &[&str]) -> (Option<i32>, Vec<(String, String)>, String) {
    let output = Process::nearl(&[&["doctor"], arguments].concat()).output();
    let out = String::from_utf8_lossy(&output.stdout).into_owned();
    let word = |line: &str, n: usize| line.split_whitespace().nth(n).unwrap_or_default().to_owned();
    let lines = out.lines().map(|l| (word(l, 0), word(l, 1))).collect();
    (output.status.code(), lines, out)
}

/// What the doctor found of the plant.
fn of_plant(lines: &[(String, String)]) -> &str {
    lines.iter().find(|(_, check)| check == "plant").map_or("nothing", |(finding, _)| finding)
}

#[test]
fn the_doctor_checks_snapshot_machine_and_plant() {
    let panda = panda();
    let file = panda.to_str().expect("UTF-8");
    let name = format!("doctor-{}", std::process::id());
    let plant = Process::nearl(&["plant", "Panda-reach", "--name", &name, "--lockstep", "--json"]);
    let (code, lines, out) = doctor(&[file, "--plant", &name]);
    assert_eq!(code, Some(0), "{out}");
    let looked: Vec<&str> = lines.iter().map(|(_, check)| check.as_str()).collect();
    let all = [
        "snapshot",
        "canary",
        "model",
        "projection",
        "holding",
        "gains",
        "braking",
        "memory",
        "links",
        "priority",
        "lock",
        "clock",
        "wake-up",
        "plant",
    ];
    assert_eq!(looked, all, "{out}");
    assert!(lines.iter().all(|(finding, _)| finding == "ok" || finding == "warn"), "{out}");
    assert!(of_plant(&lines) == "ok" && out.contains("7 joints"), "{out}");
    plant.end();

    // Another robot, and no robot.
    let folder = folder();
    let cheetah = folder.path().join("cheetah.safetensors");
    nearl_tests::training("HalfCheetah-v5", "pid2-ib", 0, 1, &[]).snapshot().save(&cheetah).expect("save");
    let plant = Process::nearl(&["plant", "Panda-reach", "--name", &name, "--lockstep", "--json"]);
    let (code, lines, out) = doctor(&[cheetah.to_str().expect("UTF-8"), "--plant", &name]);
    assert_eq!((code, of_plant(&lines)), (Some(1), "fail"), "{out}");
    assert!(out.contains("`panda_joint1` on the plant"), "{out}");
    plant.end();
    let (code, lines, out) = doctor(&[file, "--plant", &name]);
    assert_eq!((code, of_plant(&lines)), (Some(1), "fail"), "{out}");
    assert!(out.contains(&format!("start `nearl plant TASK --name {name}` first")), "{out}");
    remove_files(&RobotName::new(&name).expect("name"));
}

#[test]
fn the_doctor_fails_on_a_damaged_snapshot_and_finds_what_a_killed_plant_left() {
    let name = format!("remains-{}", std::process::id());
    let plant = Process::nearl(&["plant", "Panda-reach", "--name", &name, "--lockstep", "--json"]);
    until("the plant has its links", || {
        nearl_runtime::link::remains()
            .into_iter()
            .find(|r| r.name == name && r.alive == 1 && r.bytes > 1 << 16)
    });
    plant.kill();
    let folder = folder();
    let mut bytes = std::fs::read(panda()).expect("snapshot");
    bytes[9000] ^= 1;
    let damaged = folder.path().join("damaged");
    std::fs::File::create(&damaged).and_then(|mut f| f.write_all(&bytes)).expect("file");
    let output = Process::nearl(&["doctor", damaged.to_str().expect("UTF-8"), "--json"]).output();
    assert_eq!(output.status.code(), Some(1));
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let text = |check: &str| {
        let found = report["checks"].as_array().expect("checks").iter().find(|c| c["check"] == check);
        found.unwrap_or_else(|| panic!("no {check}: {report}")).clone()
    };
    assert_eq!((&report["ok"], &text("snapshot")["finding"]), (&false.into(), &"fail".into()), "{report}");
    let said = text("snapshot")["text"].to_string();
    assert!(said.contains("digest mismatch") && said.contains(damaged.to_str().expect("UTF-8")), "{report}");
    assert_eq!(text("links")["finding"], "warn", "{report}");
    assert!(text("links")["text"].to_string().contains(&format!("/dev/shm/nearl.{name}.*")), "{report}");
    remove_files(&RobotName::new(&name).expect("name"));
}
