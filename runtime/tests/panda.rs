//! The real controller in the loop: a Panda with random weights, over real links, against forward dynamics.

mod toy;

use std::path::Path;
use std::time::Duration;

use nearl_constraints::{Dynamics, Model};
use nearl_runtime::link::*;
use nearl_runtime::net::{Activation, Dense, DenseLayer};
use nearl_runtime::normaliser::Normaliser;
use nearl_runtime::rt::*;
use nearl_runtime::snapshot::{FORMAT, ModelFormat};
use nearl_runtime::{Manifest, Networks, PolicyKind, Snapshot, Task};
use toy::Name;

const URDF: &str = include_str!("../../examples/robots/panda/panda.urdf");
const TASK: &str = include_str!("../../examples/tasks/Panda-reach.toml");
const N: usize = 7;

fn joint(i: usize) -> String {
    format!("panda_joint{}", i + 1)
}

/// Small linear congruential generator: weights in [-1, 1].
fn weights(seed: u64, n: usize) -> Vec<f32> {
    let mut x = seed;
    let mut next = || {
        x = x.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (x >> 40) as f32 / (1 << 23) as f32 - 1.0
    };
    (0..n).map(|_| next()).collect()
}

fn snapshot(version: u64, change: impl FnOnce(&mut Manifest)) -> Snapshot {
    let mut task = Task::parse("Panda-reach.toml", TASK, &[]).unwrap();
    let entries = |kind: &'static str| (0..N).map(move |i| format!("{kind}.{}", joint(i)));
    task.state.observation = entries("q").chain(entries("v")).collect();
    let effort = Model::from_urdf_text(URDF).unwrap().effort_limit().to_vec();
    let mut manifest = Manifest {
        format: FORMAT,
        task,
        model_format: ModelFormat::Urdf,
        model: URDF.into(),
        algo: "random".into(),
        policy: PolicyKind::Deterministic,
        activation: Activation::default(),
        version,
        steps: 0,
        action_lower: effort.iter().map(|e| -e).collect(),
        action_upper: effort,
    };
    change(&mut manifest);
    let n = 2 * N;
    let layer = |seed, n_in, n_out| DenseLayer {
        n_in,
        n_out,
        weight: weights(seed, n_in * n_out),
        bias: weights(seed + 1, n_out),
    };
    let policy = Dense { layers: vec![layer(version, n, 16), layer(version + 7, 16, n)] };
    let normaliser = Normaliser { mean: vec![0.0; n], std: vec![1.0; n], scale: vec![0.5; n] };
    Snapshot { manifest, networks: Networks { normaliser, policy, policy_log_std: vec![], idm: None } }
}

/// Forward dynamics and one semi-implicit Euler step: `v' = v + T a`, `q' = q + T v'`.
struct Panda {
    dynamics: Dynamics,
    lower: Vec<f64>,
    upper: Vec<f64>,
    velocity: Vec<f64>,
    effort: Vec<f64>,
    q: Vec<f64>,
    v: Vec<f64>,
    worst: [f64; 3],
    speeds: Vec<f64>,
    braked: u64,
}

impl Panda {
    fn new() -> Panda {
        let model = Model::from_urdf_text(URDF).unwrap();
        Panda {
            lower: model.lower_position_limit().to_vec(),
            upper: model.upper_position_limit().to_vec(),
            velocity: model.velocity_limit().to_vec(),
            effort: model.effort_limit().to_vec(),
            dynamics: Dynamics::new(&model),
            q: vec![0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8],
            v: vec![0.0; N],
            worst: [f64::NEG_INFINITY; 3],
            speeds: Vec::new(),
            braked: 0,
        }
    }
}

impl Plant for Panda {
    fn observe(&mut self, state: &mut StateMessage) {
        (state.nq, state.nv, state.nu, state.n_obs) = (7, 7, 7, 14);
        state.q_mut().copy_from_slice(&self.q);
        state.v_mut().copy_from_slice(&self.v);
        state.obs_mut()[..N].copy_from_slice(&self.q);
        state.obs_mut()[N..].copy_from_slice(&self.v);
    }

    fn apply(&mut self, action: &ActionMessage) {
        let (mut passive, mut a) = (vec![0.0; N], vec![0.0; N]);
        self.dynamics.passive(&self.q, &self.v, &mut passive);
        let tau: Vec<f64> = action.action().iter().zip(&passive).map(|(t, p)| t + p).collect();
        self.dynamics.aba(&self.q, &self.v, &tau, &mut a);
        for i in 0..N {
            self.v[i] += toy::DT * a[i];
            self.q[i] += toy::DT * self.v[i];
            let excess = [
                (self.q[i] - self.upper[i]).max(self.lower[i] - self.q[i]),
                self.v[i].abs() - self.velocity[i],
                action.action()[i].abs() - self.effort[i],
            ];
            for k in 0..3 {
                self.worst[k] = self.worst[k].max(excess[k]);
            }
        }
        self.speeds.push(self.v.iter().fold(0.0, |m, v| f64::max(m, v.abs())));
    }

    fn brake(&mut self) {
        self.braked += 1;
        self.v.fill(0.0);
    }
}

fn start(name: &Name, snapshot: &Snapshot) -> (Stop, std::thread::JoinHandle<(Panda, PlantReport)>) {
    let link = PlantLink::open(&name.0, &describe(&snapshot.manifest, true).unwrap()).unwrap();
    let stop = Stop::new();
    let thread = std::thread::spawn({
        let stop = stop.clone();
        move || {
            let mut plant = Panda::new();
            let runner = PlantRunner::new(link, PlantSettings::lockstep(toy::DT)).unwrap();
            let report = runner.run(&mut plant, &stop);
            (plant, report)
        }
    });
    (stop, thread)
}

struct File(std::path::PathBuf);

impl File {
    fn new(test: &str, snapshot: &Snapshot) -> File {
        let path = std::env::temp_dir().join(format!("nearl-{}-{test}.safetensors", std::process::id()));
        snapshot.save(&path).unwrap();
        File(path)
    }
}

impl Drop for File {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
    }
}

fn execute(name: &Name, file: &Path, stop: &Stop) -> std::thread::JoinHandle<Result<RunReport, RunError>> {
    let (name, file, stop) = (name.0.clone(), file.to_owned(), stop.clone());
    std::thread::spawn(move || run(&toy::settings(), &file, &name, &stop))
}

#[test]
fn random_weights_swapped_in_motion_break_no_limit_and_the_stop_ends_at_rest() {
    let name = Name::new("panda");
    let first = snapshot(1, |_| {});
    let file = File::new("panda", &first);
    let (plant_stop, plant) = start(&name, &first);
    let stop = Stop::new();
    let running = execute(&name, &file.0, &stop);
    let mut trainer = TrainerLink::open(&name.0).unwrap();
    trainer.wait_for_runtime(Duration::from_secs(20)).unwrap();
    for version in 2..=6 {
        trainer.push(version, &snapshot(version, |_| {}).to_bytes()).unwrap();
        let receipt = trainer.wait_for_receipt(version, Duration::from_secs(20)).unwrap();
        assert_eq!(receipt.verdict(), Verdict::Accepted, "{}", receipt.text());
    }
    stop.request();
    let report = running.join().unwrap().unwrap();
    plant_stop.request();
    let (plant, counted) = plant.join().unwrap();
    println!("{report}");
    assert_eq!(report.counters.swaps, 5);
    assert_eq!(report.versions.iter().map(|v| v.1).collect::<Vec<_>>(), [1, 2, 3, 4, 5, 6]);
    assert!(report.counters.raw_violations > 1000, "the raw policy must break limits: {:?}", report.counters);
    assert_eq!(report.counters.projected_violations, 0);
    assert_eq!(counted.late, 0);
    assert!(
        plant.worst.iter().all(|excess| *excess <= 1e-9),
        "position, velocity, torque: {:?}",
        plant.worst
    );
    let fastest = plant.speeds.iter().copied().fold(0.0, f64::max);
    assert!(fastest > 0.5, "the arm must move for this to mean anything: {fastest} rad/s");
    assert!(*plant.speeds.last().unwrap() < 1e-2, "it stops by its own torques");
}

#[test]
fn foreign_and_damaged_snapshots_are_refused_by_reason_while_the_loop_runs() {
    let name = Name::new("panda-foreign");
    let first = snapshot(1, |_| {});
    let file = File::new("panda-foreign", &first);
    let (plant_stop, plant) = start(&name, &first);
    let stop = Stop::new();
    let running = execute(&name, &file.0, &stop);
    let mut trainer = TrainerLink::open(&name.0).unwrap();
    trainer.wait_for_runtime(Duration::from_secs(20)).unwrap();

    let mut flipped = snapshot(2, |_| {}).to_bytes();
    *flipped.last_mut().unwrap() ^= 1;
    let good = snapshot(3, |_| {}).to_bytes();
    let renamed = |m: &mut Manifest| {
        m.model = m.model.replace("panda_joint3", "elbow");
        m.task.state.observation.iter_mut().for_each(|n| *n = n.replace("panda_joint3", "elbow"));
        m.task.state.propose.iter_mut().flatten().for_each(|n| *n = n.replace("panda_joint3", "elbow"));
    };
    let slower = |m: &mut Manifest| (m.task.time.dt, m.task.time.sim_dt) = (0.002, 0.002);
    let swapped = |m: &mut Manifest| m.task.state.observation.swap(0, 1);
    let mut diverged = snapshot(8, |_| {});
    diverged.networks.policy.layers[0].bias[0] = f32::NAN;
    let cases = [
        (2, flipped, Verdict::Corrupt, "digest"),
        (3, good[..good.len() / 2].to_vec(), Verdict::Corrupt, "cut short"),
        (4, snapshot(4, renamed).to_bytes(), Verdict::ForeignRobot, "`elbow`"),
        (5, snapshot(5, slower).to_bytes(), Verdict::ForeignPeriod, "0.002 s"),
        (6, snapshot(6, swapped).to_bytes(), Verdict::ForeignShape, "order"),
        (8, diverged.to_bytes(), Verdict::NotFinite, "NaN"),
    ];
    for (version, bytes, verdict, word) in cases {
        trainer.push(version, &bytes).unwrap();
        let receipt = trainer.wait_for_receipt(version, Duration::from_secs(20)).unwrap();
        assert_eq!(receipt.verdict(), verdict, "{}", receipt.text());
        assert!(receipt.text().contains(word), "{}", receipt.text());
    }
    stop.request();
    let report = running.join().unwrap().unwrap();
    plant_stop.request();
    plant.join().unwrap();
    assert_eq!((report.counters.swaps, report.refused_snapshots), (0, 6));
    assert_eq!(report.counters.stale, 0);
}

#[test]
fn a_wrong_start_is_one_sentence() {
    let name = Name::new("panda-start");
    let other =
        File::new("panda-start", &snapshot(1, |m| (m.task.time.dt, m.task.time.sim_dt) = (0.002, 0.002)));
    let (plant_stop, plant) = start(&name, &snapshot(1, |_| {}));
    let error = |file: &Path, settings: RunSettings| {
        run(&settings, file, &name.0, &Stop::new()).map(|_| ()).unwrap_err().to_string()
    };
    let text = error(&other.0, toy::settings());
    assert!(text.contains("0.002 s") && text.contains("0.001 s"), "{text}");
    let text = error(Path::new("/nowhere.safetensors"), toy::settings());
    assert!(text.contains("/nowhere.safetensors"), "{text}");
    let good = File::new("panda-start-good", &snapshot(1, |_| {}));
    let text = error(&good.0, RunSettings { rate: Some(500.0), ..toy::settings() });
    assert!(text.contains("500") && text.contains("1000"), "{text}");
    plant_stop.request();
    plant.join().unwrap();
}
