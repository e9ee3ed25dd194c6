//! What an episode of a task of one's own draws: random robots beside MuJoCo's own fields and a file that states them, noise and delay beside
//! arithmetic, a curriculum by hand, and a value that sees more than the policy.

use crate::leg::{columns_of_a_run_that_resumes_bit_for_bit, env_of, fixture, leg, refuses_each};
use nearl_tests::training;
use nearl_trainer::env::Env;
use nearl_trainer::evaluate::evaluate;
use nearl_trainer::rollout::{Worker, make_env, stream};
use nearl_trainer::tasks;

const CALM: [&str; 4] = ["commands={}", "pushes={}", "termination={}", "reward={ alive = 1.0 }"];
const SEEN: &str =
    "state.observation=[\"q.hip\", \"q.knee\", \"v.hip\", \"v.knee\", \"gravity.x\", \"base.wx\"]";

fn calm(more: &[&str]) -> Box<dyn Env> {
    env_of(&leg(), &[&CALM[..], &[SEEN], more].concat())
}

fn action(t: usize) -> [f64; 2] {
    let t = t as f64;
    [0.4 + 0.3 * (0.3 * t).sin(), -0.8 + 0.4 * (0.2 * t).cos()]
}

#[test]
fn mujocos_fields_are_the_files_times_what_was_drawn() {
    let mut env = calm(&[
        "random.mass=\"1 + 0.2 * uniform\"",
        "random.com={ trunk = \"0.03 * uniform\" }",
        "random.friction=\"0.8 + 0.4 * uniform\"",
        "random.strength={ all = \"0.9\" }",
        "random.stiffness={ hip = \"1.1\" }",
        "random.damping=0.5",
        "random.armature=2.0",
    ]);
    let nominal = calm(&[]).sim().model().physique();
    let names = env.sim().model().body_names();
    let trunk = names.iter().position(|n| n == "trunk").expect("trunk");
    let mut factors = Vec::new();
    for seed in 0..40 {
        env.reset(&mut stream(seed, 0)).expect("reset");
        let now = env.sim().model().physique();
        for body in 1..names.len() {
            let factor = now.mass[body] / nominal.mass[body];
            factors.push(factor);
            for k in 0..3 {
                assert!((now.inertia[body][k] - factor * nominal.inertia[body][k]).abs() < 1e-15);
                let moved = now.centre[body][k] - nominal.centre[body][k];
                assert!(if body == trunk { moved.abs() <= 0.03 && moved != 0.0 } else { moved == 0.0 });
            }
        }
        let friction = now.friction[0][0] / nominal.friction[0][0];
        assert!((0.4..1.2).contains(&friction) && now.friction[1][0] == friction * nominal.friction[1][0]);
        for (i, stiffness) in [1.1, 1.0].into_iter().enumerate() {
            let gain = 0.9 * stiffness * nominal.gain[i];
            assert!((now.gain[i] - gain).abs() < 1e-12 && (now.bias[i][1] + gain).abs() < 1e-12);
            assert!((now.bias[i][2] - 0.45 * nominal.bias[i][2]).abs() < 1e-12);
            assert!((now.force_range[i][1] - 0.9 * nominal.force_range[i][1]).abs() < 1e-12);
            assert!((now.armature[6 + i] - 0.04).abs() < 1e-15);
        }
        let column = |name: &str| env.spec().notes.iter().position(|n| n == name).expect("column");
        let own = &factors[factors.len() - (names.len() - 1)..];
        let mean = own.iter().sum::<f64>() / own.len() as f64;
        assert!((env.notes()[column("random/mass")] - mean).abs() < 1e-12);
        assert!((env.notes()[column("random/friction")] - friction).abs() < 1e-12);
    }
    let n = factors.len() as f64;
    let mean = factors.iter().sum::<f64>() / n;
    let spread = factors.iter().map(|f| (f - mean).powi(2)).sum::<f64>() / n;
    assert!((mean - 1.0).abs() < 0.03 && (spread - 0.04 / 3.0).abs() < 0.003, "{mean} {spread}");
    assert!(factors.windows(2).all(|w| w[0] != w[1]), "one draw a body");
}

/// The same motion as a file that states the changed mass, inertia and centre of mass: everything that MuJoCo derives from them is right.
#[test]
fn a_random_robot_moves_like_a_file_that_says_so() {
    let folder = tempfile::tempdir().expect("folder");
    let mut text = std::fs::read_to_string(fixture("leg.urdf")).expect("robot");
    let heavy = [
        (
            "<origin xyz=\"0.01 0 0.02\"/><mass value=\"4.0\"/>",
            "<origin xyz=\"0.04 0.03 0.05\"/><mass value=\"5.2\"/>",
        ),
        ("ixx=\"0.05\"", "ixx=\"0.065\""),
        ("iyy=\"0.06\"", "iyy=\"0.078\""),
        ("izz=\"0.07\"", "izz=\"0.091\""),
        (
            "<origin xyz=\"0 0 -0.15\"/><mass value=\"0.4\"/>",
            "<origin xyz=\"0.01 0.01 -0.14\"/><mass value=\"0.4\"/>",
        ),
    ];
    for (from, to) in heavy {
        assert!(text.contains(from), "{from}");
        text = text.replacen(from, to, 1);
    }
    std::fs::write(folder.path().join("leg.urdf"), text).expect("robot");
    std::fs::copy(fixture("leg.toml"), folder.path().join("leg.toml")).expect("task");
    let other = folder.path().join("leg.toml").display().to_string();
    let mut stated = env_of(&other, &[&CALM[..], &[SEEN]].concat());
    let mut random = calm(&["random.mass={ trunk = 1.3 }", "random.com={ trunk = 0.03, shank = 0.01 }"]);
    random.reset(&mut stream(1, 0)).expect("reset");
    let (q, v) = (random.qpos().to_vec(), random.qvel().to_vec());
    stated.set_state(&q, &v).expect("state");
    for t in 0..60 {
        random.step(&action(t));
        stated.step(&action(t));
        for (a, b) in random.qpos().iter().zip(stated.qpos()) {
            assert!((a - b).abs() < 1e-9, "step {t}: {:?} {:?}", random.qpos(), stated.qpos());
        }
    }
    let mut plain = calm(&[]);
    plain.set_state(&q, &v).expect("state");
    (0..60).for_each(|t| {
        plain.step(&action(t));
    });
    assert!((plain.qpos()[7] - random.qpos()[7]).abs() > 1e-3, "the comparison could fail");
}

#[test]
fn an_action_arrives_as_late_as_was_drawn() {
    let (mut late, mut plain) = (calm(&["delay.action=2"]), calm(&[]));
    late.reset(&mut stream(3, 0)).expect("reset");
    plain.set_state(late.qpos(), late.qvel()).expect("state");
    for t in 0..50_usize {
        late.step(&action(t));
        plain.step(&action(t.saturating_sub(2)));
        assert_eq!(late.qpos(), plain.qpos(), "step {t}");
    }
}

#[test]
fn a_state_is_known_as_late_as_was_drawn() {
    let (mut late, mut plain) = (calm(&["delay.observation=3"]), calm(&[]));
    late.reset(&mut stream(3, 0)).expect("reset");
    plain.set_state(late.qpos(), late.qvel()).expect("state");
    let look = |env: &dyn Env| {
        let (mut obs, mut q, mut v) = (vec![0.0; 6], vec![0.0; 9], vec![0.0; 8]);
        env.observe(&mut obs);
        env.state(&mut q, &mut v);
        (obs, q, v)
    };
    let mut known = vec![look(plain.as_ref())];
    for t in 0..50_usize {
        assert!(look(late.as_ref()) == known[t.saturating_sub(3)], "step {t}");
        late.step(&action(t));
        plain.step(&action(t));
        assert_eq!(late.qpos(), plain.qpos());
        known.push(look(plain.as_ref()));
    }
}

/// The robot moves as without noise; what is told of it is off by noise of the spread that was asked for, in state and observation alike.
#[test]
fn noise_lies_on_what_is_told_and_on_nothing_else() {
    let mut noisy = calm(&[
        "noise.q=\"0.01 * normal\"",
        "noise.v=\"0.5 * uniform\"",
        "noise.base_w=\"0.2 * uniform\"",
        "noise.tilt=\"0.02 * normal\"",
        "noise.bias={ q = \"0.05 * uniform\" }",
    ]);
    let mut plain = calm(&[]);
    let (mut q_off, mut v_off, mut tilt, mut biases) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for episode in 0..30 {
        noisy.reset(&mut stream(episode, 0)).expect("reset");
        plain.set_state(noisy.qpos(), noisy.qvel()).expect("state");
        let mut bias = 0.0;
        for t in 0..60 {
            noisy.step(&action(t));
            plain.step(&action(t));
            assert_eq!(noisy.qpos(), plain.qpos());
            let (mut obs, mut q, mut v, mut exact) = (vec![0.0; 6], vec![0.0; 9], vec![0.0; 8], vec![0.0; 6]);
            noisy.observe(&mut obs);
            noisy.state(&mut q, &mut v);
            plain.observe(&mut exact);
            assert_eq!([obs[0], obs[1], obs[2], obs[5]], [q[7], q[8], v[6], v[3]], "one measurement");
            let mut states = [(); 2].map(|()| (vec![0.0; 9], vec![0.0; 8]));
            noisy.actual_state(&mut states[0].0, &mut states[0].1);
            plain.state(&mut states[1].0, &mut states[1].1);
            assert!(states[0] == states[1], "as it is");
            bias += (obs[0] - exact[0]) / 60.0;
            q_off.push(obs[0] - exact[0]);
            v_off.push(obs[2] - exact[2]);
            tilt.push(obs[4] - exact[4]);
            assert!((q[3..7].iter().map(|x| x * x).sum::<f64>() - 1.0).abs() < 1e-12);
        }
        biases.push(bias);
    }
    let variance = |x: &[f64]| x.iter().map(|x| x * x).sum::<f64>() / x.len() as f64;
    let about = |x: f64, expected: f64| assert!((x / expected - 1.0).abs() < 0.25, "{x} {expected}");
    about(variance(&v_off), 0.25 / 3.0);
    about(variance(&tilt), 0.02 * 0.02);
    about(variance(&q_off), 0.01 * 0.01 + 0.05 * 0.05 / 3.0);
    assert!(biases.iter().all(|b| b.abs() < 0.056) && variance(&biases) > 4e-4, "{biases:?}");
}

/// Noise far beyond the limits breaks none: what counts is where the robot is.
#[test]
fn what_is_reached_is_counted_without_noise() {
    let fast = |limit: &str| {
        let set = [
            "constraints={ velocity = { limit = LIMIT } }".replace("LIMIT", limit),
            "noise={ q = \"1e4 * normal\", v = \"1e4 * normal\" }".into(),
        ];
        let set: Vec<&str> = set.iter().map(String::as_str).collect();
        let snapshot = training(&leg(), "ppo", 3, 1, &set).snapshot().clone();
        let e = evaluate(&snapshot, 3, 0, true).expect("evaluation");
        assert!(e.ticks > 30, "{}", e.ticks);
        (e.reached_violations, e.worst.len())
    };
    assert_eq!(fast("1e3"), (0, 0));
    let (ticks, limits) = fast("1e-3");
    assert!(ticks > 0 && limits == 1, "{ticks} {limits}");
}

/// The level rises by its step after episodes that were long enough, falls after short ones, and stands at 1 where nobody learns.
#[test]
fn a_curriculum_rises_and_falls_with_the_episodes() {
    let set = [
        "commands={ vx = \"level\" }",
        "pushes={}",
        "termination={}",
        "state.observation=[\"q.hip\", \"q.knee\", \"command.vx\"]",
        "curriculum={ start = 0.5, step = 0.1, up = \"length > 0.9 and reward.alive > 0.5\", down = \"length < 0.5\" }",
    ];
    let mut env = env_of(&leg(), &set);
    let level = |env: &dyn Env| {
        let mut obs = [0.0; 3];
        env.observe(&mut obs);
        obs[2]
    };
    let mut rng = stream(1, 0);
    env.reset(&mut rng).expect("reset");
    assert_eq!(level(env.as_ref()), 1.0, "an evaluation is at the top");
    env.start_curriculum();
    let mut levels = Vec::new();
    for steps in [0, 119, 119, 40, 80, 119] {
        (0..steps).for_each(|t| {
            env.step(&action(t));
        });
        env.reset(&mut rng).expect("reset");
        levels.push((10.0 * level(env.as_ref())).round() as i64);
    }
    assert_eq!(levels, [5, 6, 7, 6, 6, 7]);
    let told = env.spec().notes.iter().position(|n| n == "curriculum/level").expect("column");
    assert!((env.notes()[told] - 0.7).abs() < 1e-12);
}

/// Everything at once: a robot, noise, delays, a curriculum and a value that sees more.
const ALL: [&str; 11] = [
    "random={ mass = \"1 + 0.2 * uniform\", friction = \"0.8 + 0.4 * uniform\", strength = \"1 + 0.1 * uniform\" }",
    "noise={ q = \"0.01 * normal\", base_w = \"0.1 * uniform\", bias = { q = \"0.02 * uniform\" } }",
    "delay={ action = \"1 + uniform\", observation = 1 }",
    "curriculum={ step = 0.1, up = \"length > 0.2\", down = \"length < 0.1\" }",
    "commands={ every = 0.15, vx = \"level * uniform\", yaw = \"0.5 * normal\" }",
    "state.privileged=[\"z.trunk\", \"random.friction\", \"contact.foot\", \"base.vx\"]",
    "metrics={ miss = \"abs(base.vx - command.vx)\", torque = { max = \"torque.max\" } }",
    "train.n_steps=17",
    "train.n_envs=32",
    "train.ppo.batch_size=32",
    "train.ppo.n_epochs=2",
];

#[test]
fn a_resumed_training_draws_what_the_whole_one_did() {
    let columns = columns_of_a_run_that_resumes_bit_for_bit(&ALL);
    for column in ["random/mass", "random/action_delay", "curriculum/level", "metrics/miss", "metrics/torque"]
    {
        assert!(columns.iter().any(|c| c == column), "{column} is not among {columns:?}");
    }
}

/// Rows of the privileged entries are what the simulator has, beside rows of the policy that do not hold them; the snapshot is as small as without.
#[test]
fn the_value_alone_sees_what_is_privileged() {
    let more = [&ALL[..], &["pushes={}", "termination={}"]].concat();
    let mut t = training(&leg(), "ppo", 3, 1, &more);
    (0..3).for_each(|_| {
        t.iterate();
    });
    let snapshot = t.snapshot().clone();
    let inputs = snapshot.networks.policy.layers[0].n_in;
    assert_eq!(inputs, 3 + 3 + 3 + 2 + 6 + 4 + 2);
    let mut worker =
        Worker::new(make_env(&snapshot).expect("env"), &snapshot, 0.99, stream(4, 0)).expect("worker");
    worker.collect(40).expect("rows");
    let s = &worker.rows.collected.segment;
    assert_eq!((s.x.len(), s.privileged.len()), (40 * inputs, 40 * 4));
    assert_eq!(s.final_privileged.len(), 4 * s.final_x.len());
    let rows: Vec<&[f64]> = s.privileged.chunks_exact(4).collect();
    assert!(rows.iter().all(|r| (0.05..1.0).contains(&r[0]) && (0.4..1.2).contains(&r[1])));
    assert!(rows.iter().any(|r| r[2] == 1.0) && rows.iter().any(|r| r[2] == 0.0));
    assert!(rows.windows(2).filter(|w| w[0][1] != w[1][1]).count() <= 2, "the friction of an episode");
}

const MISTAKES: &[(&str, &[&str])] = &[
    ("random.masses=1", &["[random.masses]", "there are mass, inertia, com, friction"]),
    ("random.mass={ trunkk = 1.0 }", &["[random.mass.trunkk]", "did you mean 'trunk'?"]),
    ("random.mass=-1", &["[random.mass]", "no factor that is drawn is 0.01 or more"]),
    (
        "random.mass={ trunk = \"-2 + uniform\" }",
        &["[random.mass.trunk]", "no factor that is drawn is 0.01 or more"],
    ),
    ("random.strength={ all = -1 }", &["[random.strength.all]", "no factor that is drawn is 0 or more"]),
    ("delay.action='2 * sqrt(uniform)'", &["[delay.action]", "what is drawn is not a number every time"]),
    ("delay.action=-1", &["[delay.action]", "no delay that is drawn has 0 to 100 control periods"]),
    (
        "delay.observation=500",
        &["[delay.observation]", "no delay that is drawn has 0 to 100 control periods"],
    ),
    ("noise.qq=1", &["[noise.qq]", "there are q, v, base_v, base_w, tilt"]),
    ("noise.bias=1", &["[noise.bias]", "it is a table"]),
    ("delay.actions=1", &["[delay.actions]", "there are 'action' and 'observation'"]),
    (
        "curriculum={ step = 0.1, up = \"lenght > 1\" }",
        &["[curriculum.up]", "unknown name 'lenght'", "reward.track"],
    ),
    ("curriculum={ step = 2.0, up = \"1\" }", &["[curriculum.step]", "2 is outside [0, 1]"]),
    ("metrics.x={ min = \"1\" }", &["[metrics.x]", "{ max = "]),
    ("state.privileged=[\"u.hip\"]", &["[state.privileged]", "unknown name 'u.hip'"]),
];

#[test]
fn mistakes_are_named_with_their_key() {
    refuses_each(MISTAKES);
}

/// A factor on a gain that a motor of torques does not have would do nothing, and one on what MuJoCo keeps in its place would change the torque.
#[test]
fn gains_of_motors_that_are_no_drives_cannot_be_drawn() {
    for key in ["stiffness", "damping"] {
        let set = format!("random.{key}=1.1");
        let Err(error) = tasks::load(&fixture("two_link.toml").display().to_string(), &[set]) else {
            panic!("{key} is taken")
        };
        let message = error.to_string();
        let says = [&format!("[random.{key}]")[..], "no motor of the robot is a drive with such a gain"];
        assert!(says.iter().all(|part| message.contains(part)), "{message}");
    }
}
