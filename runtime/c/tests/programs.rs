//! C and C++ programs, compiled by the system's compilers, against a real loop.

#[allow(dead_code)] // its main
#[path = "../examples/driver.rs"]
mod driver;

use nearl_runtime::constraints::Model;
use nearl_runtime::link::{Exchange, Robot, RobotName, Turn};
use nearl_runtime::net::{Activation, Dense, DenseLayer};
use nearl_runtime::normaliser::Normaliser;
use nearl_runtime::rt::{ProposerSettings, RunReport, RunSettings, Stop, ThreadSettings, run};
use nearl_runtime::snapshot::FORMAT;

use nearl_runtime::{Manifest, Networks, PolicyKind, Snapshot, Task};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

const URDF: &str = r#"<robot name="carriage"><link name="rail"/><link name="carriage"><inertial><mass value="2"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="slide" type="prismatic"><parent link="rail"/><child link="carriage"/><axis xyz="1 0 0"/>
<limit lower="-0.3" upper="0.4" velocity="0.8" effort="40"/></joint></robot>"#;
const TASK: &str = r#"name = "carriage"
[model]
urdf = "carriage.urdf"
[time]
dt = 0.001
policy_every = 5
sim_dt = 0.001
[state]
observation = ["q.slide", "v.slide"]
[constraints]
position = { margin = 0.0 }
velocity = { scale = 1.0 }
acceleration = { limit = 15.0 }
torque = { scale = 1.0 }
[idm]
kind = "pinocchio"
"#;

/// A policy that wants to go far beyond every limit, to and fro.
fn snapshot() -> Snapshot {
    let manifest = Manifest {
        format: FORMAT,
        task: Task::parse("carriage", TASK, &[]).expect("task"),
        robot: Model::from_urdf_text(URDF).expect("robot").description().clone(),
        simulation: None,
        algo: "by hand".into(),
        policy: PolicyKind::Deterministic,
        activation: Activation::default(),
        functions: Vec::new(),
        version: 1,
        steps: 0,
        action_lower: vec![-40.0],
        action_upper: vec![40.0],
        moved: None,
    };
    let layer = |weight: Vec<f32>, bias: Vec<f32>| DenseLayer { n_in: 2, n_out: 2, weight, bias };
    // towards the limit it is moving to
    let policy = Dense {
        skip: None,
        layers: vec![
            layer(vec![0.0, 60.0, 0.0, 60.0], vec![0.1; 2]),
            layer(vec![5.0, 0.0, 0.0, 9.0], vec![0.0; 2]),
        ],
    };
    let normaliser = Normaliser::new(vec![0.0; 2], vec![1.0; 2], vec![0.5; 2]);
    Snapshot {
        manifest,
        networks: Networks { normaliser, policy, policy_log_std: vec![], idm: None, margins: Vec::new() },
    }
}

/// Where cargo put the library: beside this test.
fn library() -> PathBuf {
    let deps = std::env::current_exe().expect("this test").parent().expect("a folder").to_path_buf();
    let found = [deps.clone(), deps.join("..")].into_iter().find(|d| d.join("libnearl_c.so").is_file());
    found.unwrap_or_else(|| panic!("no libnearl_c.so in or above {}", deps.display()))
}

fn compile(compiler: &str, source: &str, standard: &str, folder: &Path) -> PathBuf {
    let (root, lib) = (Path::new(env!("CARGO_MANIFEST_DIR")), library());
    let out = folder.join(Path::new(source).file_stem().expect("a name"));
    let done = Command::new(compiler)
        .args([standard, "-Wall", "-Wextra", "-Wno-missing-field-initializers", "-Werror", "-O1", "-I"])
        .arg(root.join("include"))
        .arg(root.join("examples").join(source))
        .arg("-o")
        .arg(&out)
        .arg("-L")
        .arg(&lib)
        .arg(format!("-Wl,-rpath,{}", lib.display()))
        .args(["-lnearl_c", "-lm"])
        .output()
        .unwrap_or_else(|e| panic!("{compiler}: {e}"));
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    out
}

/// A program that loads the library it was compiled with, and none that lies elsewhere.
fn with_library(program: &Path) -> Command {
    let mut paths = vec![library()];
    paths.extend(std::env::var_os("LD_LIBRARY_PATH").iter().flat_map(std::env::split_paths));
    let mut command = Command::new(program);
    command.env("LD_LIBRARY_PATH", std::env::join_paths(paths).expect("paths"));
    command
}

fn numbers(text: &[u8]) -> Vec<f64> {
    String::from_utf8_lossy(text).split_whitespace().filter_map(|w| w.parse().ok()).collect()
}

/// A driver of so many ticks against a loop that runs until the driver has had enough.
fn against_a_loop(test: &str, driver: impl FnOnce(&str, u64) -> Vec<f64>) -> (Vec<f64>, RunReport) {
    against(test, RunSettings::default(), driver)
}

fn against(
    test: &str,
    settings: RunSettings,
    driver: impl FnOnce(&str, u64) -> Vec<f64>,
) -> (Vec<f64>, RunReport) {
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("carriage.safetensors");
    snapshot().save(&file).expect("saves");
    let name = RobotName::new(&format!("c{}-{test}", std::process::id())).expect("a name");
    let stop = Stop::new();
    let running = {
        let (name, stop) = (name.clone(), stop.clone());
        let thread = ThreadSettings { priority: None, cpu: None, lock_memory: false };
        let settings = RunSettings { patience: 30.0, ramp: 0.0, thread, ..settings };
        std::thread::spawn(move || run(&settings, &file, &name, &stop))
    };
    let found = driver(&name.to_string(), 3000);
    stop.request();
    (found, running.join().expect("the loop").expect("a report"))
}

fn obeys(found: &[f64], report: &RunReport) {
    let [acted, _, farthest, fastest] = found[..] else { panic!("{found:?}") };
    assert_eq!(acted, 3000.0);
    assert!(report.counters.raw_violations > 100, "the policy must ask for too much: {:?}", report.counters);
    assert!(farthest > 0.25 && farthest <= 0.4 + 1e-6, "{farthest} m");
    assert!(fastest > 0.5 && fastest <= 0.8 + 1e-6, "{fastest} m/s");
}

#[test]
fn a_driver_in_c_obeys_the_limits() {
    let folder = tempfile::tempdir().expect("a folder");
    let program = compile("cc", "driver.c", "-std=c11", folder.path());
    let (found, report) = against_a_loop("c", |name, ticks| {
        let done = with_library(&program).arg(name).arg(ticks.to_string()).output().expect("the driver runs");
        assert!(
            done.status.success(),
            "{} {}",
            String::from_utf8_lossy(&done.stdout),
            String::from_utf8_lossy(&done.stderr)
        );
        numbers(&done.stdout)
    });
    obeys(&found, &report);
}

/// The same driver in Rust.
#[test]
fn a_driver_in_rust_obeys_the_limits() {
    let (found, report) =
        against_a_loop("rust", |name, ticks| driver::drive(name, ticks).expect("a loop").to_vec());
    obeys(&found, &report);
}

/// The carriage of the examples, which waits at rest until somebody proposes: ticks acted, how far and how fast it went [m, m/s].
fn patient_carriage(name: &str, ticks: u64) -> Vec<f64> {
    let robot = Robot { lockstep: true, ..Robot::new(&["slide"], &["q.slide", "v.slide"], 1, 0.001) };
    let mut plant = Exchange::open(&RobotName::new(name).expect("a name"), &robot, 0.02).expect("a plant");
    let (mut q, mut v, mut acted, mut farthest, mut fastest) = (0.0_f64, 0.0_f64, 0, 0.0_f64, 0.0_f64);
    let end = Instant::now() + Duration::from_secs(60);
    while acted < ticks && Instant::now() < end {
        plant.state().time = acted as f64 * 0.001;
        let force = match plant.exchange(&[q], &[v], &[q, v], 0.3) {
            Turn::Act(action) => (action[0], acted += 1).0,
            Turn::Hold(action) => action[0],
            Turn::Brake => {
                std::thread::sleep(Duration::from_millis(1));
                -2.0 * v / 0.001
            }
        };
        v += 0.001 * force.clamp(-40.0, 40.0) / 2.0;
        q += 0.001 * v;
        (farthest, fastest) = (farthest.max(q.abs()), fastest.max(v.abs()));
    }
    vec![acted as f64, farthest, fastest]
}

/// The driver in Rust, the loop, and a process in C that proposes in place of its policy.
#[test]
fn a_proposer_in_c_is_kept_within_the_limits() {
    let folder = tempfile::tempdir().expect("a folder");
    let program = compile("cc", "proposer.c", "-std=c11", folder.path());
    // Generous: a machine with other work may leave the process out for long.
    let proposer = Some(ProposerSettings { age_limit: 500_000_000, hold: 500_000_000 });
    let settings = RunSettings { proposer, ..RunSettings::default() };
    let (found, report) = against("proposer", settings, |name, ticks| {
        let child =
            with_library(&program).args([name, "1000000"]).stdout(Stdio::piped()).spawn().expect("runs");
        let found = patient_carriage(name, ticks);
        let done = child.wait_with_output().expect("ends");
        assert!(numbers(&done.stdout)[0] > 50.0, "{done:?}");
        found
    });
    let c = &report.counters;
    assert!(c.proposals > 50 && c.refused_proposals == 0, "{report}");
    assert!(c.raw_violations > 100 && c.target_violations == 0, "{report}");
    let [acted, farthest, fastest] = found[..] else { panic!("{found:?}") };
    assert_eq!(acted, 3000.0);
    assert!(farthest > 0.25 && farthest <= 0.4 + 1e-6, "{farthest} m");
    assert!(fastest > 0.5 && fastest <= 0.8 + 1e-6, "{fastest} m/s");
}

#[test]
fn a_controller_in_cpp_obeys_the_limits_and_refuses_by_sentence() {
    let folder = tempfile::tempdir().expect("a folder");
    let program = compile("c++", "controller.cpp", "-std=c++17", folder.path());
    let file = folder.path().join("carriage.safetensors");
    snapshot().save(&file).expect("saves");
    let done = with_library(&program).arg(&file).output().expect("runs");
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let found = numbers(&done.stdout);
    assert!(
        found[0] > 0.25 && found[0] <= 0.4 + 1e-6 && found[1] > 0.5 && found[1] <= 0.8 + 1e-6,
        "{found:?}"
    );
    let refused = with_library(&program).arg("none.safetensors").output().expect("runs");
    assert!(!refused.status.success());
    assert!(String::from_utf8_lossy(&refused.stderr).contains("cannot read snapshot 'none.safetensors'"));
    let mut blank = snapshot();
    blank.manifest.algo = nearl_runtime::snapshot::BLANK.into();
    blank.save(&file).expect("saves");
    let refused = with_library(&program).arg(&file).output().expect("runs");
    let said = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(
        !refused.status.success()
            && said.contains("the snapshot has no policy")
            && said.contains("carriage.safetensors"),
        "{said}"
    );
}

/// A first state that is no number has no last finite one before it.
const FIRST: &str = r#"#include <math.h>
#include <nearl.h>
#include <stdio.h>
int main(int n, char **arguments) {
    char error[300];
    nearl_controller *c = n == 2 ? nearl_controller_load(arguments[1], error, sizeof error) : NULL;
    if (!c) return 1;
    double q = NAN, v = 0.0, obs[2] = {0.0, 0.0}, action = 77.0;
    for (int k = 0; k < 3; k++) {
        int status = nearl_controller_update(c, &q, &v, obs, &action, NULL);
        printf("%d %.17g\n", status < 0, action);
        q = k == 0 ? 0.1 : NAN;
    }
    nearl_controller_free(c);
    return 0;
}
"#;

#[test]
fn a_first_state_that_is_no_number_leaves_the_action_as_it_was() {
    let folder = tempfile::tempdir().expect("a folder");
    let (source, file) = (folder.path().join("first.c"), folder.path().join("carriage.safetensors"));
    std::fs::write(&source, FIRST).expect("writes");
    snapshot().save(&file).expect("saves");
    let program = compile("cc", source.to_str().expect("a path"), "-std=c11", folder.path());
    let done = with_library(&program).arg(&file).output().expect("runs");
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let found = numbers(&done.stdout);
    let [1.0, 77.0, 0.0, acted, 1.0, held] = found[..] else { panic!("{found:?}") };
    assert!(acted != 77.0 && acted == held, "{found:?}");
}

/// Waits for a time that is no number.
const PATIENCE: &str = r#"#include <math.h>
#include <nearl.h>
#include <stdio.h>
int main(int n, char **arguments) {
    char error[300] = "";
    const char *joints[] = {"slide"};
    nearl_robot robot = {.joints = joints, .n_joints = 1, .nq = 1, .nv = 1, .nu = 1, .dt = 0.01, .watchdog = 0.1};
    nearl_plant *plant = n == 2 ? nearl_plant_open(arguments[1], &robot, error, sizeof error) : NULL;
    if (!plant) return fprintf(stderr, "%s\n", error), 1;
    double q = 0.0, v = 0.0, action = 77.0;
    nearl_state state = {.q = &q, .v = &v};
    printf("%d %d %.17g\n", nearl_plant_exchange(plant, &state, NAN, &action) < 0,
           nearl_plant_exchange(plant, &state, -1.0, &action) == NEARL_BRAKE, action);
    nearl_plant_close(plant);
    if (nearl_proposer_open(arguments[1], NAN, error, sizeof error)) return 2;
    fputs(error, stderr);
    return 0;
}
"#;

#[test]
fn a_patience_that_is_no_number_is_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let source = folder.path().join("patience.c");
    std::fs::write(&source, PATIENCE).expect("writes");
    let program = compile("cc", source.to_str().expect("a path"), "-std=c11", folder.path());
    let done =
        with_library(&program).arg(format!("c{}-patience", std::process::id())).output().expect("runs");
    let said = String::from_utf8_lossy(&done.stderr).into_owned();
    assert!(done.status.success(), "{said}");
    assert_eq!(numbers(&done.stdout), [1.0, 1.0, 77.0]);
    assert_eq!(said, "patience is no number; give the seconds to wait");
}

/// Every function that the library exports is declared, and the other way round.
#[test]
fn the_header_names_exactly_what_is_defined() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let read = |path: &str| std::fs::read_to_string(root.join(path)).expect("a source");
    let names = |text: &str, before: &str| -> std::collections::BTreeSet<String> {
        let starts = text.match_indices(before).map(|(at, found)| &text[at + found.len() - "nearl_".len()..]);
        let name = |rest: &str| {
            rest.split(|c: char| !(c.is_alphanumeric() || c == '_')).next().unwrap_or_default().to_string()
        };
        starts.filter(|rest| rest[name(rest).len()..].starts_with('(')).map(name).collect()
    };
    let header = names(&read("include/nearl.h"), "nearl_");
    let defined: String =
        ["src/lib.rs", "src/plant.rs", "src/proposer.rs", "src/controller.rs"].map(read).concat();
    assert_eq!(header, names(&defined, "extern \"C\" fn nearl_"));
    assert!(header.len() >= 10, "{header:?}");
}
