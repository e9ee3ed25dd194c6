//! A policy goes out as ONNX and comes back; damaged files are refused and never break the program.

use nearl_runtime::Controller;
use nearl_tests::training;
use nearl_trainer::export;
use nearl_trainer::import::{Gives, ImportError, Setting, for_task, onnx};
use rand::RngExt;

const SHORT: [&str; 3] = ["train.n_envs=4", "train.n_steps=32", "train.ppo.batch_size=64"];

#[test]
fn what_was_exported_comes_back() {
    let mut t = training("HalfCheetah-v5", "ppo", 0, 1, &SHORT);
    (0..3).for_each(|_| drop(t.iterate()));
    let snapshot = t.snapshot().clone();
    let bytes = export::onnx(&snapshot).expect("exports");
    let network = onnx("policy.onnx", &bytes, None, None).expect("imports");
    assert_eq!(network.dense, snapshot.networks.policy, "weights are the same numbers");
    let back = for_task(&network, snapshot.manifest.clone(), Gives::Actuators).expect("fits");
    let mut both = [&snapshot, &back].map(|s| Controller::new(s).expect("controller"));
    let mut rng = nearl_trainer::rollout::stream(3, 0);
    for _ in 0..100 {
        let actions = both.each_mut().map(|controller| {
            let (mut state, mut out) = (controller.state(), controller.output());
            let mut same = rng.clone();
            state.obs.iter_mut().for_each(|x| *x = 20.0 * (same.random::<f64>() - 0.5));
            controller.update(&state, &controller.noise(), &mut out);
            out.action
        });
        let _: f64 = rng.random();
        let differs = |(a, b): (&f64, &f64)| (a - b).abs() > 1e-6;
        assert!(!actions[0].iter().zip(&actions[1]).any(differs), "{actions:?}");
    }
}

/// The robot file is all it takes: gears, and on Ant another order of the motors than of the joints, are in the file.
#[test]
fn a_policy_of_motors_comes_back_with_the_robot_file_alone() {
    for (task, file) in [
        ("HalfCheetah-v5", "half_cheetah"),
        ("Hopper-v5", "hopper"),
        ("Walker2d-v5", "walker2d_v5"),
        ("Ant-v5", "ant"),
    ] {
        let robot = format!("{}/../examples/robots/gymnasium/{file}.xml", env!("CARGO_MANIFEST_DIR"));
        let mut t = training(task, "ppo", 0, 1, &SHORT);
        (0..3).for_each(|_| drop(t.iterate()));
        let snapshot = t.snapshot().clone();
        let network =
            onnx("policy.onnx", &export::onnx(&snapshot).expect("exports"), None, None).expect("imports");
        let setting = Setting { name: "back", robot: std::path::Path::new(&robot), recipes: &[] };
        let back =
            nearl_trainer::import::snapshot(&network, &setting).unwrap_or_else(|e| panic!("{task}: {e}"));
        let mut both = [&snapshot, &back].map(|s| Controller::new(s).expect("controller"));
        let mut rng = nearl_trainer::rollout::stream(3, 0);
        let mut largest = 0.0f64;
        for _ in 0..100 {
            let obs: Vec<f64> = both[0].state().obs.iter().map(|_| rng.random::<f64>() - 0.5).collect();
            let actions = both.each_mut().map(|controller| {
                let (mut state, mut out) = (controller.state(), controller.output());
                state.obs.copy_from_slice(&obs);
                controller.update(&state, &controller.noise(), &mut out);
                out.action
            });
            let [before, after] = &actions;
            assert_eq!(before.len(), after.len(), "{task}");
            assert!(before.iter().zip(after).all(|(a, b)| (a - b).abs() < 1e-6), "{task}: {actions:?}");
            largest = before.iter().fold(largest, |most, a| most.max(a.abs()));
        }
        assert!(largest > 1e-3, "{task}: {largest}");
    }
}

/// The task brings the limits and the inverse dynamics, the file the change of the state in its units.
#[test]
fn a_policy_that_proposes_comes_back_into_its_task() {
    let snapshot = training("Panda-reach", "pid2-ib", 0, 1, &SHORT).snapshot().clone();
    let network = onnx("policy.onnx", &export::onnx(&snapshot).expect("exports"), None, None).expect("reads");
    let mut manifest = nearl_trainer::tasks::load("Panda-reach", &[]).expect("bundled");
    nearl_trainer::train::complete(&mut manifest).expect("bundled");
    let other = for_task(&network, manifest.clone(), Gives::State).expect_err("a change").to_string();
    assert!(other.contains("is the 'change' that 'nearl export' wrote"), "{other}");
    let back = for_task(&network, manifest, Gives::Change).expect("fits");
    let mut both = [&snapshot, &back].map(|s| Controller::new(s).expect("controller"));
    let mut rng = nearl_trainer::rollout::stream(3, 0);
    let mut largest = 0.0f64;
    for _ in 0..100 {
        let obs: Vec<f64> = both[0].state().obs.iter().map(|_| 0.4 * (rng.random::<f64>() - 0.5)).collect();
        let outputs = both.each_mut().map(|controller| {
            let (mut state, mut out) = (controller.state(), controller.output());
            state.q.copy_from_slice(&obs[..7]);
            state.v.copy_from_slice(&obs[7..14]);
            state.obs.copy_from_slice(&obs);
            controller.reset();
            controller.update(&state, &controller.noise(), &mut out);
            [out.proposal, out.action]
        });
        for (before, after) in outputs[0].iter().zip(&outputs[1]) {
            assert!(
                before.iter().zip(after).all(|(a, b)| (a - b).abs() < 1e-6 * a.abs().max(1.0)),
                "{outputs:?}"
            );
        }
        largest =
            outputs[0][0].iter().zip(&obs).fold(largest, |most, (to, from)| most.max((to - from).abs()));
    }
    assert!(largest > 1e-4, "{largest}");
}

/// What a policy proposes is no action, and without a task the file is refused for that.
#[test]
fn a_proposal_is_not_imported_as_an_action() {
    let snapshot = training("HalfCheetah-v5", "pid2-ib", 0, 1, &SHORT).snapshot().clone();
    let network = onnx("policy.onnx", &export::onnx(&snapshot).expect("exports"), None, None).expect("reads");
    let robot = concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/robots/gymnasium/half_cheetah.xml");
    let setting = Setting { name: "back", robot: std::path::Path::new(robot), recipes: &[] };
    let refused = nearl_trainer::import::snapshot(&network, &setting).unwrap_err().to_string();
    assert!(
        refused.contains("'change' is a change of state") && refused.contains("--task FILE --actions change"),
        "{refused}"
    );
}

#[test]
fn damaged_files_are_refused_in_a_sentence() {
    let snapshot = training("HalfCheetah-v5", "ppo", 0, 1, &SHORT).snapshot().clone();
    let good = export::onnx(&snapshot).expect("exports");
    let mut rng = nearl_trainer::rollout::stream(5, 0);
    let (mut refused, mut read) = (0, 0);
    for _ in 0..2000 {
        let mut bytes = good.clone();
        for _ in 0..rng.random_range(1..4) {
            let at = rng.random_range(0..bytes.len().min(3000));
            bytes[at] = rng.random();
        }
        if rng.random::<f64>() < 0.2 {
            bytes.truncate(rng.random_range(0..good.len()));
        }
        match onnx("policy.onnx", &bytes, None, None) {
            Ok(network) => read += usize::from(network.n_in() > 0),
            Err(error) => {
                refused += 1;
                assert_eq!(error.to_string().lines().count(), 1, "{error}");
            }
        }
    }
    assert!(refused > 200 && read > 200, "{refused} refused, {read} read");
}

#[test]
fn a_recipe_has_the_limit_of_a_task_file() {
    let snapshot = training("HalfCheetah-v5", "ppo", 0, 1, &SHORT).snapshot().clone();
    let bytes = export::onnx(&snapshot).expect("exports");
    let mut network = onnx("policy.onnx", &bytes, None, None).expect("imports");
    network.metadata.insert("nearl_recipe".into(), "=".repeat((1 << 20) + 1));
    let setting = Setting { name: "x", robot: std::path::Path::new("no.urdf"), recipes: &[] };
    let error = nearl_trainer::import::snapshot(&network, &setting).unwrap_err().to_string();
    assert_eq!(error, "metadata 'nearl_recipe': it has 1048577 bytes, more than the limit of 1048576");
    network.metadata.clear();
    let folder = tempfile::tempdir().expect("folder");
    let recipe = folder.path().join("beyond.toml");
    std::fs::write(&recipe, "=".repeat((1 << 20) + 1)).expect("recipe");
    let error = nearl_trainer::import::snapshot(
        &network,
        &Setting { recipes: std::slice::from_ref(&recipe), ..setting },
    );
    let error = error.unwrap_err().to_string();
    assert!(error.contains("beyond.toml") && error.contains("more than the limit of 1048576"), "{error}");
}

/// Weights that the reader of a snapshot refuses are refused where they come from, by tensor, index and value.
#[test]
fn weights_that_are_none_are_named_in_the_file_they_come_from() {
    let good = training("HalfCheetah-v5", "ppo", 0, 1, &SHORT).snapshot().clone();
    for (value, said) in
        [(3e38_f32, "3e38"), (f32::NAN, "NaN"), (f32::NEG_INFINITY, "-inf"), (2e6, "2000000")]
    {
        // Export refuses them, so they take the place of a weight that is one.
        const WEIGHT: f32 = 1234.5;
        let mut snapshot = good.clone();
        snapshot.networks.policy.layers[0].bias[3] = WEIGHT;
        let mut bytes = export::onnx(&snapshot).expect("exports");
        let at = bytes.windows(4).position(|w| w == WEIGHT.to_le_bytes()).expect("the weight");
        bytes[at..at + 4].copy_from_slice(&value.to_le_bytes());
        let error = onnx("policy.onnx", &bytes, None, None).expect_err("no weights");
        assert!(matches!(&error, ImportError::Value { index: 3, .. }), "{error}");
        let error = error.to_string();
        for words in
            ["policy.onnx: tensor '", &format!("has {said}"), "at index 3", "export an earlier checkpoint"]
        {
            assert!(error.contains(words), "{error}");
        }
    }
    // An entry that never varied: the deviation, not what comes of it, and no other checkpoint.
    const DEVIATION: f64 = 1234.5;
    let mut snapshot = good.clone();
    snapshot.networks.normaliser.std[2] = DEVIATION;
    let mut bytes = export::onnx(&snapshot).expect("exports");
    let at = bytes.windows(4).position(|w| w == (DEVIATION as f32).to_le_bytes()).expect("the deviation");
    bytes[at..at + 4].copy_from_slice(&0.0_f32.to_le_bytes());
    let error = onnx("policy.onnx", &bytes, None, None).expect_err("no deviation");
    assert!(matches!(&error, ImportError::Deviation { index: 2, .. }), "{error}");
    let error = error.to_string();
    assert!(
        error.contains("policy.onnx: the standard deviation of entry 2 of the input 'obs' is 0")
            && !error.contains("checkpoint"),
        "{error}"
    );
    // A mistake beside the weights: what no reader takes, no writer writes.
    let mut network =
        onnx("policy.onnx", &export::onnx(&good).expect("exports"), None, None).expect("imports");
    network.std[2] = 1e13;
    let error =
        for_task(&network, good.manifest.clone(), Gives::Actuators).expect_err("no deviation").to_string();
    assert!(
        error.contains("'normaliser.std' has 1e13 at index 2, and no observation counts beyond 1e12"),
        "{error}"
    );
}
