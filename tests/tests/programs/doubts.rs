//! Set-ups that are refused, or allowed although hardly anybody means them. The Rust builder, the reader of task files and the doctor each say
//! what is wrong by name, number and unit. What the doctor says of them is the table of `docs/DOCTOR.md`:
//! `NEARL_WRITE=1 cargo test --release -p nearl-tests --test programs doubts`.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use crate::common::repository;
use nearl_runtime::Snapshot;
use nearl_runtime::constraints::limit::AccelerationSettings;
use nearl_runtime::constraints::{
    AccelerationLimit, Limit, Model, PerJoint, PositionLimit, Projector, Settings, TorqueLimit, VelocityLimit,
};
use nearl_runtime::controller::Parts;
use nearl_runtime::doctor::{Check, Finding, examine, told};
use nearl_runtime::recipe::PolicySection;
use nearl_trainer::tasks;
use nearl_trainer::train::{Request, Training, advice, complete};

/// Limits as they are built in Rust.
struct Limits {
    velocity: PerJoint,
    acceleration: AccelerationSettings,
    dt: f64,
}

fn usual() -> Limits {
    let acceleration = AccelerationSettings::of(PerJoint::All(30.0), None);
    Limits { velocity: PerJoint::All(4.0), acceleration, dt: 0.01 }
}

/// A change of a text: what is replaced, and by what.
type Edit = (&'static str, &'static str);
/// The robot as it is, or the task.
const SAME: Edit = ("", "");

struct SetUp {
    /// What is odd about it, in the words of the page.
    what: &'static str,
    robot: Edit,
    task: Edit,
    /// The same from Rust; none where it is not a matter of limits.
    limits: Option<fn(&mut Limits)>,
    /// Words of what each door says; none for a good one.
    says: &'static [&'static str],
    is_refused: bool,
    /// The check of the doctor that says it; none where no snapshot can hold it.
    check: Option<&'static str>,
}

const VELOCITY: &str = "velocity = { limit = 4.0 }";
const ACCELERATION: &str = "acceleration = { limit = 30.0 }";

const SET_UPS: &[SetUp] = &[
    SetUp {
        what: "an arm with limits it can keep",
        robot: SAME,
        task: SAME,
        limits: Some(|_| ()),
        says: &[],
        is_refused: false,
        check: Some("model"),
    },
    SetUp {
        what: "velocity limits in degrees: 160",
        robot: SAME,
        task: (VELOCITY, "velocity = { limit = 160.0 }"),
        limits: Some(|l| l.velocity = PerJoint::All(160.0)),
        says: &["velocity limit of 'shoulder' is 160 rad/s", "degrees"],
        is_refused: false,
        check: Some("model"),
    },
    SetUp {
        what: "an acceleration limit of 0.001",
        robot: SAME,
        task: (ACCELERATION, "acceleration = { limit = 0.001 }"),
        limits: Some(|l| l.acceleration = AccelerationSettings::of(PerJoint::All(0.001), None)),
        says: &["acceleration limit of 'shoulder' is 0.001 rad/s²", "4000 s to stop"],
        is_refused: false,
        check: Some("model"),
    },
    SetUp {
        what: "a hard jerk limit of 0.01",
        robot: SAME,
        task: (ACCELERATION, "acceleration = { limit = 30.0 }\njerk = { limit = 0.01, hard = true }"),
        limits: None,
        says: &["jerk limit of 'shoulder' is 0.01 rad/s³", "40 s to stop"],
        is_refused: false,
        check: Some("model"),
    },
    SetUp {
        what: "a range of 150 in the robot file",
        robot: ("range=\"-2 2\"", "range=\"-75 75\""),
        task: SAME,
        limits: Some(|_| ()),
        says: &["range of 'shoulder' is", "rad or m", "degrees"],
        is_refused: false,
        check: Some("model"),
    },
    SetUp {
        what: "a control period of 5 s",
        robot: SAME,
        task: ("dt = 0.01\nsim_dt", "dt = 5.0\nsim_dt"),
        limits: Some(|l| l.dt = 5.0),
        says: &["control period is 5 s", "milliseconds"],
        is_refused: false,
        check: Some("model"),
    },
    SetUp {
        what: "limits of another robot's joints",
        robot: SAME,
        task: (VELOCITY, "velocity = { limit = { panda_joint1 = 2.0 } }"),
        limits: Some(|l| l.velocity = PerJoint::Joints([("panda_joint1".into(), 2.0)].into())),
        says: &["velocity", "'panda_joint1'", "does not have"],
        is_refused: true,
        check: None,
    },
    SetUp {
        what: "braking above the acceleration limit",
        robot: SAME,
        task: (ACCELERATION, "acceleration = { limit = 30.0, braking = 40.0 }"),
        limits: Some(|l| {
            l.acceleration = AccelerationSettings::of(PerJoint::All(30.0), Some(PerJoint::All(40.0)))
        }),
        says: &["braking of joint 'shoulder' is 40 rad/s²", "acceleration limit of 30"],
        is_refused: true,
        check: None,
    },
    SetUp {
        what: "episodes that begin outside the limits",
        robot: SAME,
        task: ("[constraints]", "[reset]\nq = { elbow = 2.5 }\n\n[constraints]"),
        limits: None,
        says: &["64 of 64 episodes begin with joint 'elbow' outside", "2.5000 rad", "[reset]"],
        is_refused: false,
        check: None,
    },
    SetUp {
        what: "a learned inverse model of targets that move position and velocity together",
        robot: SAME,
        task: (
            "kind = \"pinocchio\"\n\n[train]\nexploration = \"proposal\"",
            "kind = \"learned\"\n\n[train]\nexploration = \"action\"",
        ),
        limits: None,
        says: &["'kinematic'", "learned inverse model", "consistency = \"free\""],
        is_refused: true,
        check: None,
    },
    SetUp {
        what: "motors too weak to hold the arm",
        robot: SAME,
        task: ("torque = {}", "torque = { scale = 0.02 }"),
        limits: None,
        says: &["'shoulder'", "N m"],
        is_refused: false,
        check: Some("holding"),
    },
    SetUp {
        what: "motors that have too little force at standstill to hold the arm",
        robot: SAME,
        task: ("torque = {}", "torque = {}\ntorque_speed = { stall = 1.6, no_load = 3.0 }"),
        limits: None,
        says: &["'shoulder' needs 38.5 N m or N of its 1.6", "stall of torque_speed"],
        is_refused: false,
        check: Some("holding"),
    },
    SetUp {
        what: "a joint that nothing drives, beside analytic inverse dynamics",
        robot: ("<motor joint=\"elbow\" ctrlrange=\"-30 30\"/>", ""),
        task: ("[state]", "[state]\ncontrollable = [\"shoulder\"]"),
        limits: None,
        says: &["inverse dynamics by the model reckon with 'elbow'", "kind = \"learned\""],
        is_refused: false,
        check: Some("model"),
    },
    SetUp {
        what: "a range in the robot file that no limit keeps the joints in",
        robot: SAME,
        task: ("position = { margin = 0.02 }\n", ""),
        limits: None,
        says: &["nothing keeps 'shoulder', 'elbow' from the end of the range", "position = { margin = 0.0 }"],
        is_refused: false,
        check: Some("model"),
    },
    SetUp {
        what: "a speed limit of a point, and five physics steps in a control period",
        robot: ("timestep=\"0.01\"", "timestep=\"0.002\""),
        task: (
            "sim_dt = 0.01\n\n[state]\n\n[reward]\nstill = \"-v.elbow^2\"\n\n[constraints]",
            "sim_dt = 0.002\n\n[state]\n\n[reward]\nstill = \"-v.elbow^2\"\n\n[constraints]\nframe_speed = [{ frame = \"elbow\", limit = 0.5 }]",
        ),
        limits: None,
        says: &["5 physics steps", "limits on frame_speed hold only approximately", "policy_every = 5"],
        is_refused: false,
        check: Some("model"),
    },
    SetUp {
        what: "two planes with nothing between them",
        robot: SAME,
        task: (
            "torque = {}",
            "torque = {}\nframe = [\n  { name = \"low\", frame = \"elbow\", half_space = { normal = [0, 0, 1], through = [0, 0, 0.6] }, braking = 5.0 },\n  \
             { name = \"high\", frame = \"elbow\", half_space = { normal = [0, 0, -1], through = [0, 0, 0.8] }, braking = 5.0 },\n]",
        ),
        limits: None,
        says: &["the limits of frames 'low', 'high' hold each alone, and in no pose", "0.100 m outside"],
        is_refused: false,
        check: Some("model"),
    },
    SetUp {
        what: "a box that the arm does not reach",
        robot: SAME,
        task: (
            "torque = {}",
            "torque = {}\nframe = [{ frame = \"elbow\", box = { lower = [-0.1, -0.1, 2.0], upper = [0.1, 0.1, 2.2] }, braking = 5.0 }]",
        ),
        limits: None,
        says: &["the limit of frame 'elbow' holds in no pose", "0.841 m outside"],
        is_refused: false,
        check: Some("model"),
    },
];

fn edited(text: String, (from, to): Edit) -> String {
    assert!(text.contains(from), "'{from}' is not there");
    if from.is_empty() { text } else { text.replacen(from, to, 1) }
}

/// Writes robot and task of a set-up; returns the task file.
fn write(folder: &Path, robot: Edit, task: Edit) -> PathBuf {
    let fixture =
        |name: &str| std::fs::read_to_string(repository().join("tests/fixtures").join(name)).expect(name);
    std::fs::write(folder.join("two_link.xml"), edited(fixture("two_link.xml"), robot)).expect("robot");
    let file = folder.join("two_link.toml");
    std::fs::write(&file, edited(fixture("two_link.toml"), task)).expect("task");
    file
}

/// The usual task, complete, and the folder that it is in.
fn completed() -> (tempfile::TempDir, nearl_runtime::Manifest) {
    let folder = tempfile::tempdir().expect("folder");
    let file = write(folder.path(), SAME, SAME);
    let mut manifest = tasks::load(file.to_str().expect("UTF-8"), &[]).expect("task");
    complete(&mut manifest).expect("manifest");
    (folder, manifest)
}

/// A door's answer: what it warns of, or why it refuses.
type Answer = Result<Vec<String>, String>;

/// The Rust builder, with the robot of the task in `file`.
fn build(file: &Path, change: fn(&mut Limits)) -> Answer {
    let manifest = tasks::load(file.to_str().expect("UTF-8"), &[]).expect("the usual task");
    let model: Model = Parts::robot(&manifest).expect("robot");
    let mut wish = usual();
    change(&mut wish);
    let limits: Vec<Box<dyn Limit>> = vec![
        Box::new(PositionLimit::with_margin(0.02)),
        Box::new(VelocityLimit::values(wish.velocity)),
        Box::new(AccelerationLimit::new(wish.acceleration)),
        Box::new(TorqueLimit::scaled(1.0)),
    ];
    let settings = Settings::new(wish.dt, 1);
    let projector = Projector::new(&model, &limits, &[0, 1], settings).map_err(|e| e.to_string())?;
    Ok([model.notes(), projector.notes()].concat())
}

/// The task file, as a training begins with it; its first snapshot goes to `snapshot`.
fn train(file: &Path, snapshot: &Path) -> Answer {
    let mut manifest = tasks::load(file.to_str().expect("UTF-8"), &[]).map_err(|e| e.to_string())?;
    complete(&mut manifest).map_err(|e| e.to_string())?;
    let algo = "pid2-ib".parse().expect("an algorithm");
    let lines = advice(algo, &manifest).map_err(|e| e.to_string())?;
    let request = Request { manifest, algo, steps: 1000, seed: 0, threads: 1 };
    let training = Training::new(&request).map_err(|e| e.to_string())?;
    training.snapshot().save(snapshot).expect("snapshot");
    Ok(lines)
}

fn hears(set_up: &SetUp, door: &str, answer: &Answer) {
    let what = set_up.what;
    let text = match answer {
        Ok(lines) if set_up.is_refused => panic!("{what}: {door} does not refuse it: {lines:?}"),
        Ok(lines) => lines.join("\n"),
        Err(text) if set_up.is_refused => text.clone(),
        Err(text) => panic!("{what}: {door} refuses it: {text}"),
    };
    for word in set_up.says {
        assert!(text.contains(word), "{what}: '{word}' is not in what {door} says: {text}");
    }
    assert!(!set_up.says.is_empty() || text.is_empty(), "{what}: {door} says {text}");
}

/// Text in the lines of a list's entry.
fn wrapped(text: &str) -> String {
    let (mut out, mut width) = (String::new(), 0);
    for word in text.split_whitespace() {
        let length = word.chars().count() + 1;
        if width == 0 || width + length > 150 {
            (out, width) = (out + "\n ", 0);
        }
        out = out + " " + word;
        width += length;
    }
    out
}

#[test]
fn odd_set_ups_are_named_by_each_door_and_the_page_says_what_the_doctor_says() {
    let mut page = String::from(
        "# What the doctor says\n\n`nearl doctor SNAPSHOT` looks at a snapshot, its task and its robot; what it refuses is not run. \
         `nearl train` and `nearl.Projector` say the same of\ntheir own. Written by `NEARL_WRITE=1 cargo test --release -p nearl-tests \
         --test programs doubts`; a test fails when this page is old.\n\n| set-up | finding |\n|---|---|\n",
    );
    let mut lines = String::from("\n## What is said of each\n\n");
    let mut tell = |what: &str, finding: &str, text: &str| {
        writeln!(page, "| {what} | {finding} |").expect("a text");
        writeln!(lines, "- {what}:{}", wrapped(text)).expect("a text");
    };
    for set_up in SET_UPS {
        let folder = tempfile::tempdir().expect("folder");
        let snapshot = folder.path().join("first.safetensors");
        if let Some(change) = set_up.limits {
            let plain = write(folder.path(), set_up.robot, SAME);
            hears(set_up, "the builder", &build(&plain, change));
        }
        let file = write(folder.path(), set_up.robot, set_up.task);
        let trained = train(&file, &snapshot);
        hears(set_up, "the task file", &trained);
        let Some(check) = set_up.check else {
            let text = trained.map_or_else(|refusal| refusal, |lines| lines.join("; "));
            let finding =
                if set_up.is_refused { "refused by `nearl train`" } else { "said by `nearl train`" };
            let text = text.replace(&folder.path().display().to_string(), "FOLDER").replace('\n', " ");
            tell(set_up.what, finding, &text);
            continue;
        };
        let checks = examine(&snapshot, None);
        let found: &Check = checks.iter().find(|c| c.check == check).expect(check);
        assert_eq!(found.finding == Finding::Ok, set_up.says.is_empty(), "{}: {}", set_up.what, found.text);
        for word in set_up.says {
            assert!(found.text.contains(word), "{}: '{word}' is not in: {}", set_up.what, found.text);
        }
        if found.finding == Finding::Fail {
            let notes = told(&Snapshot::load(&snapshot).expect("snapshot").manifest).expect("notes");
            let refuses =
                |note: &String| note.starts_with(&found.text) && note.contains("`nearl run` refuses");
            assert!(notes.iter().any(refuses), "{}: {notes:?}", set_up.what);
        }
        let finding = format!("{:?}", found.finding).to_lowercase();
        tell(set_up.what, &finding, &found.text);
    }
    page += &lines;
    let file = repository().join("docs/DOCTOR.md");
    if std::env::var_os("NEARL_WRITE").is_some() {
        std::fs::write(&file, &page).expect("page");
    }
    let found = std::fs::read_to_string(&file).unwrap_or_default();
    assert!(found == page, "docs/DOCTOR.md is old: run the command in its fourth line");
}

const MOTORS: &str =
    "<motor joint=\"shoulder\" ctrlrange=\"-80 80\"/>\n    <motor joint=\"elbow\" ctrlrange=\"-30 30\"/>";
const ELBOW: &str = "range=\"-2.2 2.2\" damping=\"1\"";

/// The arm with drives of stiffness 100 N m/rad, the elbow's with targets up to `end` \[rad\] and `friction` \[N m\], by a task with these changes.
fn driven(folder: &Path, (end, friction): (f64, f64), changes: &[Edit]) -> PathBuf {
    let drive = |joint: &str, end: f64| {
        format!(
            "<position joint=\"{joint}\" kp=\"100\" kv=\"10\" ctrlrange=\"-{end} {end}\" forcerange=\"-80 80\"/>"
        )
    };
    let file = write(folder, SAME, SAME);
    let robot = std::fs::read_to_string(folder.join("two_link.xml")).expect("robot");
    let robot = robot.replace(MOTORS, &(drive("shoulder", 2.5) + &drive("elbow", end)));
    let robot = robot.replace(ELBOW, &format!("{ELBOW} frictionloss=\"{friction}\""));
    std::fs::write(folder.join("two_link.xml"), robot).expect("robot");
    let command = "[command]\ninterface = \"pd\"\nstiffness = 100.0\ndamping = 10.0\n\n[constraints]";
    let text = std::fs::read_to_string(&file).expect("task").replace("[constraints]", command);
    let text = changes.iter().fold(text, |text, change| edited(text, *change));
    std::fs::write(&file, text).expect("task");
    file
}

/// What a training with `algo` says of it.
fn advised(file: &Path, algo: &str) -> String {
    let mut manifest = tasks::load(file.to_str().expect("UTF-8"), &[]).expect("task");
    complete(&mut manifest).expect("manifest");
    advice(algo.parse().expect("an algorithm"), &manifest).expect("advice").join("\n")
}

/// By hand: 20 N m at 100 N m/rad take 0.2 rad either way, of the 0.2 rad between targets of -0.1 and 0.1.
#[test]
fn drives_that_no_target_lets_make_up_for_friction_are_named() {
    let folder = tempfile::tempdir().expect("folder");
    let text = advised(&driven(folder.path(), (0.1, 20.0), &[]), "pid2-ib");
    assert!(
        text.contains(
            "'elbow' (20.000 N m or N, which takes 0.400 rad or m of the 0.200 that its range has)"
        ),
        "{text}"
    );
    let text = advised(&driven(folder.path(), (2.5, 20.0), &[]), "pid2-ib");
    assert!(!text.contains("make up for dry friction"), "{text}");
}

/// By hand: 25 N m of friction take 0.25 rad off the targets of -2.2 to 2.2, the spring's 8.7 and the weight's 0.7 another 0.095; without a position limit the
/// robot file's range counts.
#[test]
fn joints_that_drives_hold_in_a_part_of_their_range_are_named() {
    let folder = tempfile::tempdir().expect("folder");
    let holding = |file: &Path| {
        let snapshot = folder.path().join("first.safetensors");
        train(file, &snapshot).expect("a snapshot");
        examine(&snapshot, None).into_iter().find(|check| check.check == "holding").expect("holding")
    };
    // Where nothing limits the position, the load is looked for up to half a turn.
    for (changes, from) in [(&[][..], "-1.855"), (&[("position = { margin = 0.02 }\n", "")][..], "-1.817")] {
        let found = holding(&driven(folder.path(), (2.2, 25.0), changes));
        assert!(
            found.finding == Finding::Warn && found.text.contains(&format!("'elbow' from {from}")),
            "{}",
            found.text
        );
        assert!(!found.text.contains("inf"), "{}", found.text);
        let found = holding(&driven(folder.path(), (2.6, 1.0), changes));
        assert!(found.finding == Finding::Ok, "{}", found.text);
    }
}

/// A guard on the forces of drives knows nothing of the rest.
#[test]
fn what_a_guard_on_forces_does_not_hold_is_named() {
    let folder = tempfile::tempdir().expect("folder");
    const GUARD: Edit = ("torque = {}", "torque = {}\nguard = \"drive\"");
    const FORCES: Edit = ("position = { margin = 0.02 }\nvelocity = { limit = 4.0 }\n", "");
    let says = |changes: &[Edit]| advised(&driven(folder.path(), (2.5, 0.0), changes), "ppo");
    let text = says(&[GUARD, FORCES]);
    assert!(!text.contains("constraints.guard is") && !text.contains("joints at their limits"), "{text}");
    assert!(says(&[GUARD]).contains("nothing holds position, velocity of [constraints]"));
    let delayed =
        says(&[GUARD, FORCES, ("[reward]", "[delay]\naction = 1\n\n[random]\nstrength = 1.2\n\n[reward]")]);
    assert!(delayed.contains("beside delay.action, random.strength the forces"), "{delayed}");
    // 80 - (10 + 100 x 0.01) x 1000 x 0.01 is below 0.
    let text = says(&[GUARD, FORCES, (ACCELERATION, "acceleration = { limit = 1000.0 }")]);
    assert!(text.contains("'shoulder' (nothing of 80.000 N m or N at 1000 rad/s² or m/s²)"), "{text}");
}

/// A bundled task draws its own episodes: what it says is something that its user can do.
#[test]
fn a_bundled_task_advises_nothing_that_it_has_not() {
    let mut manifest = tasks::load("Hopper-v5", &[]).expect("bundled");
    complete(&mut manifest).expect("bundled");
    let lines = advice("ppo".parse().expect("an algorithm"), &manifest).expect("advice");
    let line = lines.iter().find(|l| l.contains("'thigh_joint'")).unwrap_or_else(|| panic!("{lines:?}"));
    assert!(line.contains("the bundled task draws it there") && !line.contains("draw it inside"), "{line}");
}

/// A rail without ends reaches everywhere, and a box far away is none that cannot be reached.
#[test]
fn a_box_on_an_endless_rail_is_no_doubt() {
    const HINGE: &str = "type=\"hinge\" axis=\"0 1 0\" range=\"-2 2\"";
    const FAR: Edit = (
        "torque = {}",
        "torque = {}\nframe = [{ frame = \"elbow\", box = { lower = [7.0, -1.0, 0.0], upper = [8.0, 1.0, 2.0] }, braking = 5.0 }]",
    );
    for (joint, is_out) in
        [("type=\"slide\" axis=\"1 0 0\"", false), ("type=\"slide\" axis=\"1 0 0\" range=\"-2 2\"", true)]
    {
        let folder = tempfile::tempdir().expect("folder");
        let file = write(folder.path(), (HINGE, joint), FAR);
        let mut manifest = tasks::load(file.to_str().expect("UTF-8"), &[]).expect("task");
        complete(&mut manifest).expect("manifest");
        let notes = told(&manifest).expect("notes");
        assert_eq!(notes.iter().any(|note| note.contains("holds in no pose")), is_out, "{notes:?}");
    }
}

/// Of the limits of a policy on actions those on actions are kept, and the doctor does not deny it.
#[test]
fn limits_on_actions_are_what_a_direct_policy_keeps() {
    for (action, says) in
        [("", "none is kept;"), ("action = { square = 9.0 }", "none is kept but [constraints.action];")]
    {
        let folder = tempfile::tempdir().expect("folder");
        let file = write(folder.path(), SAME, ("torque = {}", action));
        let mut manifest = tasks::load(file.to_str().expect("UTF-8"), &[]).expect("task");
        complete(&mut manifest).expect("manifest");
        let algo = "ppo".parse().expect("an algorithm");
        let training =
            Training::new(&Request { manifest, algo, steps: 1000, seed: 0, threads: 1 }).expect("training");
        let snapshot = folder.path().join("first.safetensors");
        training.snapshot().save(&snapshot).expect("snapshot");
        let checks = examine(&snapshot, None);
        let found = checks.iter().find(|c| c.check == "projection").expect("projection");
        assert!(found.finding == Finding::Warn && found.text.contains(says), "{}", found.text);
    }
}

/// What a guard that steps a simulator does not look at was taken without a word, and so was a penalty on what no projection moves.
#[test]
fn a_simulator_s_guard_names_what_it_does_not_look_at() {
    let folder = tempfile::tempdir().expect("folder");
    let said = |algo: &str, set: &[&str]| {
        let file = write(folder.path(), SAME, SAME);
        let set: Vec<String> = set.iter().map(|set| (*set).to_owned()).collect();
        let mut manifest = tasks::load(file.to_str().expect("UTF-8"), &set).expect("task");
        complete(&mut manifest).expect("manifest");
        advice(algo.parse().expect("an algorithm"), &manifest).expect("advice").join("; ")
    };
    const SIMULATOR: &str = "constraints.guard=\"simulator\"";
    let others = said("ppo", &[SIMULATOR, "constraints.energy={ limit = 0.1 }"]);
    assert!(others.contains("an action may break acceleration, torque, energy of [constraints]"), "{others}");
    assert!(!said("ppo", &["constraints.guard=true"]).contains("may break"));
    let only = said(
        "ppo",
        &["constraints={ guard = \"simulator\", consistency = \"free\", velocity = { limit = 3.0 } }"],
    );
    assert!(!only.contains("\"simulator\""), "{only}");
    let none = said("ppo", &["constraints={ guard = \"simulator\", acceleration = { limit = 3.0 } }"]);
    assert!(none.contains("names neither position nor velocity"), "{none}");
    let late = said("ppo", &[SIMULATOR, "delay.action=2"]);
    assert!(late.contains("[delay] action"), "{late}");
    const PENALTY: &str = "train.moved_penalty=10";
    for (algo, guard, is_vain) in
        [("ppo", SIMULATOR, true), ("ppo", "constraints.guard=true", false), ("pid2-ib", SIMULATOR, false)]
    {
        let said = said(algo, &[guard, PENALTY]);
        assert_eq!(said.contains("takes nothing off any reward"), is_vain, "{algo} {guard}: {said}");
    }
}

/// Links that move and weigh nothing are named by every door.
#[test]
fn a_moving_link_without_an_inertia_is_named() {
    let text = std::fs::read_to_string(repository().join("tests/fixtures/leg.urdf")).expect("robot");
    let at = text.find("<link name=\"shank\">").expect("shank");
    let end = at + text[at..].find("</link>").expect("end");
    let mut light = format!("{}<link name=\"shank\">{}", &text[..at], &text[end..]);
    let foot = light.find("<link name=\"foot\">").expect("foot");
    let end = foot + light[foot..].find("</link>").expect("end");
    light.replace_range(foot + "<link name=\"foot\">".len()..end, "");
    let model = Model::from_urdf_text(&light).expect("it is read");
    let notes = model.notes().join("; ");
    assert!(
        notes.contains("'shank'") && notes.contains("no mass") && notes.contains("<inertial>"),
        "{notes}"
    );
}

/// What a policy sees and asks for is relative to its pose: one in degrees had the joint go to the end of its range, and nothing said so.
/// A recipe whose steps are not those of the robot file: accelerations came out at twice their limit, and nothing but the plant said so.
#[test]
fn physics_steps_that_are_not_the_file_s_are_named() {
    let (_folder, manifest) = completed();
    let stated = manifest.task.time.sim_dt;
    let notes = |sim_dt: f64| {
        let mut manifest = manifest.clone();
        manifest.task.time.sim_dt = sim_dt;
        let about = |note: &String| note.contains("timestep");
        told(&manifest).expect("notes").into_iter().filter(about).collect::<Vec<_>>()
    };
    assert!(stated > 0.0 && notes(stated).is_empty() && notes(0.0).is_empty());
    let found = notes(0.005);
    let says = format!("sim_dt is 0.005 s, and the robot file's timestep is {stated} s");
    assert!(found.len() == 1 && found[0].contains(&says), "{found:?}");
    let by = |integrator: &str, sim_dt: f64| {
        let mut manifest = manifest.clone();
        manifest.task.time.sim_dt = sim_dt;
        let file = manifest.simulation.as_mut().expect("a robot file");
        file.text =
            file.text.replacen("</mujoco>", &format!("<option integrator=\"{integrator}\"/></mujoco>"), 1);
        let notes = told(&manifest).expect("notes");
        notes.into_iter().filter(|note| note.contains(&format!("integrator is {integrator}"))).count()
    };
    assert_eq!(["RK4", "implicit", "implicitfast", "Euler"].map(|name| by(name, stated)), [1, 1, 0, 0]);
    assert_eq!(by("RK4", 0.0), 0);
}

#[test]
fn a_pose_outside_of_a_range_is_named() {
    let (_folder, manifest) = completed();
    let joints = ["elbow", "shoulder"].map(String::from).to_vec();
    let notes = |pose: [f64; 2]| {
        let mut manifest = manifest.clone();
        let section =
            PolicySection { joints: joints.clone(), pose: pose.to_vec(), ..PolicySection::default() };
        manifest.task.policy = Some(section);
        told(&manifest).expect("notes").into_iter().filter(|note| note.contains("pose")).collect::<Vec<_>>()
    };
    assert!(notes([-2.2, 2.0]).is_empty());
    let found = notes([-90.0, 1.5]);
    assert!(
        found.len() == 1 && found[0].contains("'elbow' is -90 rad or m, outside of its range of -2.2 to 2.2"),
        "{found:?}"
    );
}
