//! Names in the lists of a task file: with braces, as expressions ask for where a name has other signs, and without.

use nearl_runtime::Controller;
use nearl_runtime::link::hash_names;
use nearl_trainer::blank;
use nearl_trainer::demos::{Demonstrations, Episode};
use nearl_trainer::rollout::{make_env, stream};
use std::path::Path;

/// A robot of two joints, `left-hip` and `knee`, and a task of it with `state` as `[state]`; an environment of its own where it has a reward.
fn task(folder: &Path, state: &str, reward: &str, idm: &str) -> String {
    let link = |name: &str| {
        format!(
            r#"<link name="{name}"><inertial><mass value="1"/><origin xyz="0 0 0.1"/>
            <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.02"/></inertial></link>"#
        )
    };
    let joint = |name: &str, parent: &str, child: &str| {
        format!(
            r#"<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/><origin xyz="0 0 0.2"/><axis xyz="0 1 0"/>
            <limit lower="-1" upper="1" effort="20" velocity="3"/></joint>"#
        )
    };
    let links = [link("base"), link("thigh"), link("shank")].concat();
    let joints = [joint("left-hip", "base", "thigh"), joint("knee", "thigh", "shank")].concat();
    std::fs::write(folder.join("leg.urdf"), format!(r#"<robot name="leg">{links}{joints}</robot>"#))
        .expect("robot");
    let text = format!(
        "name = \"leg\"\n[model]\nurdf = \"leg.urdf\"\n[time]\ndt = 0.002\nsim_dt = 0.002\n[state]\n{state}\n{reward}\n[constraints]\n\
         position = {{}}\nvelocity = {{}}\nacceleration = {{ limit = 20.0 }}\ntorque = {{}}\n[idm]\n{idm}\n"
    );
    let file = folder.join("leg.toml");
    std::fs::write(&file, text).expect("task");
    file.display().to_string()
}

const ANALYTIC: &str = "kind = \"pinocchio\"";

/// `state` with and without braces around every name.
fn both(state: &str) -> [String; 2] {
    let mut quotes = 0;
    let braced = state.chars().map(|c| {
        quotes += usize::from(c == '"');
        match (c, quotes % 2) {
            ('"', 1) => "\"{".to_string(),
            ('"', _) => "}\"".to_string(),
            _ => c.to_string(),
        }
    });
    let braced = braced.collect();
    [state.to_string(), braced]
}

#[test]
fn a_name_in_braces_is_the_same_name_in_every_list() {
    let folder = tempfile::tempdir().expect("folder");
    for state in [
        r#"observation = ["q.left-hip", "q.knee", "v.left-hip", "v.knee"]"#,
        "observation = [\"q.left-hip\", \"q.knee\", \"v.left-hip\", \"v.knee\", \"goal-x\"]\npropose = [\"v.left-hip\", \"q.left-hip\", \"v.knee\"]\n\
         controllable = [\"left-hip\", \"knee\"]",
    ] {
        let made = both(state).map(|state| {
            blank::snapshot(&task(folder.path(), &state, "", ANALYTIC), false)
                .unwrap_or_else(|e| panic!("{state}: {e}"))
        });
        assert_eq!(made[0].to_bytes(), made[1].to_bytes(), "the same file for {state}");
        assert_eq!(made[1].manifest.action_lower.len(), 2, "both joints are controllable");
        assert_eq!(made[1].manifest.task.state.observation[0], "q.left-hip");
    }
    // An environment reads the entries as expressions, and a name is one before it is a difference.
    for state in both(r#"observation = ["q.left-hip", "q.knee", "v.left-hip", "v.knee"]"#) {
        let file = task(folder.path(), &state, "[reward]\nstill = \"-v.knee^2\"", ANALYTIC);
        let snapshot = blank::snapshot(&file, false).unwrap_or_else(|e| panic!("{state}: {e}"));
        let (mut env, controller) =
            (make_env(&snapshot).expect("env"), Controller::new(&snapshot).expect("controller"));
        env.reset(&mut stream(1, 0)).expect("reset");
        let mut obs = vec![0.0; 4];
        env.observe(&mut obs);
        assert_eq!(obs, [env.qpos(), env.qvel()].concat());
        assert_eq!(controller.layout().controllable(), [0, 1]);
    }
    // What the inverse model sees.
    let state = "observation = [\"{q.left-hip}\", \"{v.left-hip}\", \"q.knee\", \"v.knee\"]";
    let file = task(
        folder.path(),
        state,
        "[reward]\nstill = \"-v.knee^2\"",
        "kind = \"learned\"\ninput = [\"{v.left-hip}\", \"q.knee\"]",
    );
    let text = std::fs::read_to_string(&file).expect("task");
    std::fs::write(
        &file,
        text.replace("[constraints]", "[constraints]\nconsistency = \"free\"").replace("torque = {}", ""),
    )
    .expect("task");
    let snapshot = nearl_tests::random_policy(&file, 1, 1.0);
    assert_eq!(snapshot.networks.idm.as_ref().expect("a learned model").0.n_in(), 4);
    // Columns of demonstrations, and the entries that a plant says it observes.
    let names = ["{q.left-hip}".to_string(), "v.knee".to_string()];
    let episode = Episode { length: 1, observations: vec![1.0, 2.0, 3.0, 4.0], ..Episode::default() };
    let demos = Demonstrations { names: names.to_vec(), dt: 0.01, episodes: vec![episode] };
    let plain = ["v.knee".to_string(), "q.left-hip".to_string()];
    assert_eq!(demos.columns(&plain).expect("columns").episodes[0].observations, [2.0, 1.0, 4.0, 3.0]);
    assert_eq!(hash_names(&names), hash_names(["q.left-hip", "v.knee"]));
}

#[test]
fn one_entry_in_both_spellings_is_there_twice() {
    let folder = tempfile::tempdir().expect("folder");
    let file = task(folder.path(), r#"observation = ["q.left-hip", "{q.left-hip}"]"#, "", ANALYTIC);
    let error = blank::snapshot(&file, false).expect_err("twice").to_string();
    assert!(error.contains("state.observation names 'q.left-hip' twice"), "{error}");
}

/// A period in which nothing could be seen, gains that nothing reads, and limits on actions beside a torque that is computed.
#[test]
fn what_no_reader_takes_is_refused_before_a_file_is_written() {
    let folder = tempfile::tempdir().expect("folder");
    let state = r#"observation = ["q.left-hip", "q.knee", "v.left-hip", "v.knee"]"#;
    let refused = |from: &str, to: &str| {
        let file = task(folder.path(), state, "", ANALYTIC);
        let text = std::fs::read_to_string(&file).expect("task");
        assert!(text.contains(from), "{from}");
        std::fs::write(&file, text.replace(from, to)).expect("task");
        blank::snapshot(&file, false).expect_err(to).to_string()
    };
    let late = refused("[state]", "policy_every = 100000000000\n[state]");
    assert!(
        late.contains("time.policy_every") && late.contains("200000000 s in which the policy sees nothing"),
        "{late}"
    );
    let gains = refused("[idm]", "[command]\ninterface = \"effort\"\nstiffness = 100.0\n[idm]");
    assert!(gains.contains("[command.stiffness] is given, but every joint is sent a force"), "{gains}");
    let action = refused("torque = {}", "torque = {}\naction = { power = 20.0 }");
    assert!(action.contains("action") && action.contains("pinocchio"), "{action}");
    let reached = refused("torque = {}", "torque = {}\nreached = 0.01");
    assert!(reached.contains("reached") && reached.contains("pinocchio"), "{reached}");
}
