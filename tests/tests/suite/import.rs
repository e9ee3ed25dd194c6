//! A policy goes out as ONNX and comes back; damaged files are refused and never break the program.

use nearl_runtime::net::{Dense, DenseLayer, Function};
use nearl_runtime::{Controller, Snapshot};
use nearl_tests::training;
use nearl_trainer::export;
use nearl_trainer::import::{Gives, ImportError, ImportedNetwork, Setting, for_task, onnx};
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

/// What mjlab 1.6.0 writes (`list_to_csv_str`): numbers of three decimals, `;` within an entry, a clip for each term, `base_lin_vel` of a velocimeter.
const OF_MJLAB: [(&str, &str); 11] = [
    ("joint_names", "hip,knee"),
    ("joint_stiffness", "20.000,30.000"),
    ("joint_damping", "1.000,2.000"),
    ("default_joint_pos", "0.100,-0.200"),
    ("action_scale", "0.500,0.250"),
    ("command_names", "twist"),
    ("observation_names", "base_lin_vel,base_ang_vel,projected_gravity,joint_pos,joint_vel,actions,command"),
    ("observation_terms_scale", "2.000,0.250;0.250;0.100,1.000,1.000,0.050,1.000,2.000;3.000;0.250"),
    ("observation_terms_clip", "-inf;inf,-inf;0.500,-inf;inf,-0.500;0.500,-inf;inf,-inf;inf,-inf;inf"),
    ("observation_terms_history_length", "0,0,0,0,3,0,0"),
    ("observation_terms_flatten_history_dim", "1.000,1.000,1.000,1.000,1.000,1.000,1.000"),
];

const SENSORS: &str =
    r#"<sensor><gyro name="imu_ang_vel" site="imu"/><velocimeter site='imu' name = "imu_lin_vel"/></sensor>"#;

/// A base that floats, with two joints; `imu` are the attributes of a site on it.
fn floating(imu: &str, sensors: &str) -> String {
    let inertial = "<inertial pos='0 0 0' mass='1' diaginertia='.1 .1 .1'/>";
    format!(
        "<mujoco><worldbody><body name='base' pos='0 0 1'><freejoint/>{inertial}<site name='imu' {imu}/>
        <body name='thigh'><joint name='hip' axis='0 1 0' range='-2 2' limited='true'/>{inertial}
        <body name='shank' pos='0 0 -.3'><joint name='knee' axis='0 1 0' range='-2 2' limited='true'/>{inertial}
        <site name='toe'/></body></body></body></worldbody>
        <actuator><position name='hip' joint='hip' kp='20' kv='1' ctrlrange='-3 3' forcerange='-50 50'/>
        <position name='knee' joint='knee' kp='30' kv='2' ctrlrange='-3 3' forcerange='-50 50'/></actuator>
        <!-- <velocimeter name='imu_lin_vel' site='toe'/> -->{sensors}</mujoco>"
    )
}

/// The policy with mjlab's metadata and what `other` says in its place, on a robot, by a recipe.
fn of_mjlab(other: &[(&str, &str)], robot: &str, recipe: &str) -> Result<Snapshot, String> {
    const N: usize = 22;
    let folder = tempfile::tempdir().expect("folder");
    let files = ["robot.xml", "recipe.toml"].map(|name| folder.path().join(name));
    std::fs::write(&files[0], robot).expect("robot");
    std::fs::write(&files[1], recipe).expect("recipe");
    let layer = DenseLayer { n_in: N, n_out: 2, weight: vec![0.1; 2 * N], bias: vec![0.0; 2] };
    let pairs = OF_MJLAB.iter().chain(other).map(|(k, v)| ((*k).to_string(), (*v).to_string()));
    let network = ImportedNetwork {
        mean: vec![0.0; N],
        std: vec![1.0; N],
        clip: vec![[f64::NEG_INFINITY, f64::INFINITY]; N],
        dense: Dense { layers: vec![layer], ..Dense::default() },
        functions: vec![Function::Identity],
        output: vec![[f64::NEG_INFINITY, f64::INFINITY]; 2],
        input_name: "obs".into(),
        output_name: "actions".into(),
        metadata: pairs.collect(),
    };
    let setting = Setting { name: "legs", robot: &files[0], recipes: &files[1..] };
    nearl_trainer::import::snapshot(&network, &setting).map_err(|e| e.to_string())
}

/// What the policy sees in one state that is not at rest.
fn seen(snapshot: &Snapshot) -> Vec<f64> {
    let mut controller = Controller::new(snapshot).expect("controller");
    let (mut state, mut out) = (controller.state(), controller.output());
    state.q.copy_from_slice(&[0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.9, 0.1]);
    state.v.copy_from_slice(&[0.4, -0.3, 0.2, 1.0, 2.0, 3.0, 5.0, -7.0]);
    let n = state.obs.len();
    state.obs[n - 3..].copy_from_slice(&[0.5, -0.25, 0.75]);
    controller.update(&state, &controller.noise(), &mut out);
    out.x.iter().map(|x| f64::from(*x)).collect()
}

/// In that state by hand. Linear: (0.4, -0.3, 0.2) + (1, 2, 3) x (0.1, -0.2, 0.3) = (1.6, -0.3, -0.2), and twice that.
const SEEN: [f64; 22] = [
    3.2, -0.6, -0.4, // base_lin_vel of the site
    0.125, 0.125, 0.05, // 1, 2 and 3 are cut to 0.5
    0.0, 0.0, -1.0, //
    0.5, 0.3, // 0.8 is cut to 0.5
    0.25, -0.35, 0.25, -0.35, 0.25, -0.35, // three ticks
    0.0, 0.0, //
    1.0, -0.75, 0.1875, // a scale for each
];

fn assert_seen(snapshot: Result<Snapshot, String>, want: &[f64]) {
    let found = seen(&snapshot.unwrap_or_else(|e| panic!("{e}")));
    let near = |(a, b): (&f64, &f64)| (a - b).abs() < 1e-6;
    assert!(found.len() == want.len() && found.iter().zip(want).all(near), "{found:?}, not {want:?}");
}

const IMU: &str = "pos='0.1 -0.2 0.3'";
const PERIOD: &str = "[time]\ndt = 0.02\n";

/// A scale for each entry, and every clip, had been left out or refused.
#[test]
fn terms_of_mjlab_have_their_scales_clips_and_histories() {
    let robot = floating(IMU, SENSORS);
    assert_seen(of_mjlab(&[], &robot, PERIOD), &SEEN);
    // Before 1.6: no scale and no clip are None.
    let old = [
        ("observation_terms_scale", "2.0,None,None,1.0,0.05,None,None"),
        ("observation_terms_clip", "None,None,None,None,None,None,None"),
        ("observation_terms_flatten_history_dim", "True,True,True,True,True,True,True"),
    ];
    let mut want = SEEN;
    want[3..6].copy_from_slice(&[1.0, 2.0, 3.0]);
    want[9] = 0.8;
    want[19..].copy_from_slice(&[0.5, -0.25, 0.75]);
    assert_seen(of_mjlab(&old, &robot, PERIOD), &want);
}

/// Pose and scale of the metadata had been taken for those of the recipe's joints.
#[test]
fn joints_in_another_order_than_mjlab_s_need_their_own_pose_and_scale() {
    let robot = floating(IMU, SENSORS);
    let turned = format!("{PERIOD}[policy]\njoints = [\"knee\", \"hip\"]\n");
    let error = of_mjlab(&[], &robot, &turned).expect_err("another order");
    assert!(
        error.contains("'joint_names'") && error.contains("state policy.pose, policy.action in"),
        "{error}"
    );
    let stated = format!("{turned}pose = [-0.2, 0.1]\naction = {{ scale = 0.5 }}\n");
    of_mjlab(&[], &robot, &stated).expect("stated");
    let scales = [("observation_terms_scale", "1.000,1.000,1.000,1.000,0.050;0.060,1.000,1.000")];
    let error = of_mjlab(&scales, &robot, &stated).expect_err("scales by joint");
    assert!(error.contains("state policy.observation in the recipe"), "{error}");
    of_mjlab(&[], &robot, &turned.replace("\"knee\", \"hip\"", "\"hip\", \"knee\"")).expect("the same order");
}

/// A drive without a range of targets is refused where it is simulated; a robot on legs is told of the guard that is for it.
#[test]
fn what_keeps_a_robot_on_legs_from_being_simulated_is_named() {
    let robot = floating(IMU, SENSORS);
    let told = |robot: &str| {
        let snapshot = of_mjlab(&[], robot, PERIOD).expect("imported");
        nearl_runtime::doctor::told(&snapshot.manifest).expect("notes").join("\n")
    };
    let text = told(&robot);
    assert!(text.contains("add guard = \"drive\"") && !text.contains("have no ctrlrange"), "{text}");
    let text = told(&robot.replace(" kv='2' ctrlrange='-3 3'", " kv='2'"));
    assert!(text.contains("actuators 'knee' have no ctrlrange"), "{text}");
}

/// They had been left out without a word, and the policy saw other numbers.
#[test]
fn terms_of_mjlab_that_cannot_be_read_are_refused_by_key() {
    let robot = floating(IMU, SENSORS);
    for (key, value, said) in [
        ("scale", "2.000,0.250", "has 2 entries for the 7 terms of observation_names"),
        ("scale", "2.0,0.2;x;0.1,1,1,1,1,1", "entry 2 (term 'base_ang_vel') is '0.2;x;0.1', no number"),
        ("scale", "nan,1,1,1,1,1,1", "entry 1 (term 'base_lin_vel') is 'nan', no number"),
        ("scale", "1,1,1,1;1;1,1,1,1", "entry 4 has 3 numbers for the 2 entries of term 'joint_pos'"),
        ("scale", "1,1,1,1,1,1,1;1", "entry 7 has 2 numbers for the 3 entries of term 'command'"),
        ("clip", "(-1.0, 1.0),None,None,None,None,None,None", "has 8 entries for the 7 terms"),
        (
            "clip",
            "-inf;inf,1,None,None,None,None,None",
            "entry 2 (term 'base_ang_vel') is '1', where the lowest",
        ),
        ("clip", "1;-1,None,None,None,None,None,None", "entry 1 (term 'base_lin_vel') is '1;-1', where"),
        ("clip", "nan;1,None,None,None,None,None,None", "entry 1 (term 'base_lin_vel') is 'nan;1', where"),
        ("history_length", "0,0,0,x,3,0,0", "entry 4 (term 'joint_pos') is 'x', no number of ticks"),
        ("history_length", "0,0,0,-1,3,0,0", "entry 4 (term 'joint_pos') is '-1', no number of ticks"),
        ("history_length", "0,0,0,1e9,3,0,0", "entry 4 (term 'joint_pos') is '1e9', no number of ticks"),
        ("history_length", "3", "'3' has 1 entries for the 7 terms"),
        ("flatten_history_dim", "1,1,1,1,False,1,1", "entry 5 (term 'joint_vel') is 'False', and a history"),
    ] {
        let key = format!("observation_terms_{key}");
        let error = of_mjlab(&[(&key, value)], &robot, PERIOD).expect_err(value);
        assert!(error.starts_with(&format!("metadata '{key}': ")) && error.contains(said), "{error}");
        assert!(error.contains("; state all of policy.observation in a recipe (--recipe FILE"), "{error}");
    }
    let error = of_mjlab(&[("default_joint_pos", "nan,0")], &robot, PERIOD).expect_err("no pose");
    assert_eq!(error, "metadata 'default_joint_pos': 'nan,0' is no list of numbers; export the policy again");
}

/// As the messages say.
#[test]
fn terms_of_mjlab_are_not_looked_at_where_a_recipe_states_them() {
    let recipe = r#"[policy]
        observation = [{ term = "constant", value = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0, 13.0, 14.0, 15.0, 16.0] },
                       { term = "base_lin_vel" }, { term = "command", entries = ["command.a", "command.b", "command.c"] }]"#;
    let want: Vec<f64> = (1..=16).map(f64::from).chain([0.4, -0.3, 0.2, 0.5, -0.25, 0.75]).collect();
    for (key, value) in [
        ("observation_terms_clip", "1;-1"),
        ("observation_terms_scale", "x"),
        ("observation_terms_history_length", "x"),
        ("observation_names", "base_lin_vel,height_scan"),
    ] {
        let robot = floating(IMU, SENSORS);
        assert_seen(of_mjlab(&[(key, value)], &robot, &format!("{PERIOD}{recipe}")), &want);
    }
}

/// mjlab's is of a velocimeter, which the origin of the base had been taken for.
#[test]
fn the_velocity_of_the_base_is_that_of_the_velocimeter_in_the_robot_file() {
    let of = |sensors: &str, imu: &str| of_mjlab(&[], &floating(imu, sensors), PERIOD);
    let sensor =
        |name: &str, site: &str| format!("<sensor><velocimeter name='{name}' site='{site}'/></sensor>");
    assert_seen(of(&sensor("other", "imu"), IMU), &SEEN);
    let two = format!("{SENSORS}{}", sensor("foot", "toe"));
    assert_seen(of(&two, IMU), &SEEN);
    let mut at_origin = SEEN;
    at_origin[..3].copy_from_slice(&[0.8, -0.6, 0.4]);
    assert_seen(of(SENSORS, "pos='0 0 0'"), &at_origin);
    let notes =
        |snapshot: &Snapshot| nearl_runtime::doctor::told(&snapshot.manifest).expect("notes").join("\n");
    let said = "does not say where on the base its base_lin_vel was measured, and ";
    for (sensors, is_told) in [("", true), (&sensor("foot", "toe"), true), (SENSORS, false)] {
        let made = of(sensors, "pos='0 0 0'").expect("imports");
        assert_eq!(notes(&made).contains(said), is_told, "{}", notes(&made));
        assert_seen(Ok(made), &at_origin);
    }
    for (sensors, imu, said) in [
        (
            SENSORS,
            "pos='0.1 0 0' euler='0 0 90'",
            "robot.xml: the velocimeter at site 'imu' is turned against the base",
        ),
        (
            &sensor("imu_lin_vel", "toe"),
            IMU,
            "the velocimeter 'imu_lin_vel' is at site 'toe', which is not on the base",
        ),
    ] {
        let error = of(sensors, imu).expect_err("no term");
        assert!(
            error.contains(said) && error.contains("; state all of policy.observation in a recipe"),
            "{error}"
        );
    }
    // A policy that does not see it, and one whose recipe says what it sees, have nothing to be told.
    let blind = [(
        "observation_names",
        "base_ang_vel,projected_gravity,base_ang_vel,joint_pos,joint_vel,actions,command",
    )];
    assert!(!notes(&of_mjlab(&blind, &floating(IMU, ""), PERIOD).expect("imports")).contains(said));
}
