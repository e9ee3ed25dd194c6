//! Demonstrations: what is recorded comes back bit for bit, is what NumPy reads and writes, and bad files are refused by name.

use nearl_tests::training;
use nearl_trainer::demos::npz::{self, Array, Values};
use nearl_trainer::demos::{Demonstrations, record};
use nearl_trainer::{env, tasks};
use std::path::{Path, PathBuf};
use std::process::Command;

fn recorded(folder: &Path, task: &str) -> (PathBuf, Demonstrations) {
    let snapshot = training(task, "pid2-ib", 3, 1, &[]).snapshot().clone();
    let (demos, _) = record(&snapshot, 3, 1).expect("episodes");
    let file = folder.join("demos.npz");
    demos.save(&file).expect("saved");
    (file, demos)
}

#[test]
fn what_is_recorded_comes_back_and_is_of_its_task() {
    let folder = tempfile::tempdir().expect("folder");
    for task in ["Hopper-v5", "HalfCheetah-v5", "Ant-v5"] {
        let (file, demos) = recorded(folder.path(), task);
        assert_eq!(Demonstrations::load(&file).expect("read"), demos, "{task}");
        let manifest = tasks::load(task, &[]).expect("task");
        let mut env = env::of_task(&manifest, task).expect("environment");
        demos.check(&mut *env, manifest.task.time.dt).unwrap_or_else(|e| panic!("{task}: {e}"));
        let e = &demos.episodes[0];
        assert_eq!(e.observations.len(), (e.length + 1) * demos.names.len());
        // the same actions from the first state lead to the same states
        let (nq, nv, n_act) = (env.qpos().len(), env.qvel().len(), e.actions.len() / e.length);
        env.set_state(&e.qpos[..nq], &e.qvel[..nv]).expect("first state");
        for t in 0..e.length.min(20) {
            env.step(&e.actions[t * n_act..][..n_act]);
            assert_eq!(env.qpos(), &e.qpos[(t + 1) * nq..][..nq], "{task}, step {t}");
        }
        let error = demos.check(&mut *env, 2.0 * manifest.task.time.dt).expect_err("another period");
        assert!(error.contains("its period is"), "{error}");
        let mut odd = demos.clone();
        odd.episodes[1].qpos[2] += 0.1;
        let error = odd.check(&mut *env, manifest.task.time.dt).expect_err("another state");
        assert!(error.starts_with("episode 1 begins with "), "{error}");
        let mut narrow = demos.clone();
        let e = &mut narrow.episodes[1];
        e.actions.truncate((n_act - 1) * e.length);
        let error = narrow.check(&mut *env, manifest.task.time.dt).expect_err("fewer actuators");
        assert!(
            error.contains("of episode 1 have") && error.contains(&format!("{n_act} actuators")),
            "{error}"
        );
        let mut forces = demos.clone();
        forces.episodes[1].actions.iter_mut().for_each(|x| *x *= 1e6);
        let error = forces.check(&mut *env, manifest.task.time.dt).expect_err("forces");
        assert!(error.starts_with("'actions' of episode 1: ") && error.contains("not forces"), "{error}");
    }
}

/// A goal, a command and noise are of the reset and not of the state: they are taken as they were recorded. The state is still compared.
#[test]
fn what_a_reset_draws_is_taken_as_it_was_recorded() {
    let two_link = concat!(env!("CARGO_MANIFEST_DIR"), "/fixtures/two_link.toml");
    let command = [
        "commands={ x = \"uniform\" }",
        "state.observation=[\"q.shoulder\", \"q.elbow\", \"v.shoulder\", \"v.elbow\", \"command.x - q.elbow\"]",
        "state.propose=[\"q.shoulder\", \"q.elbow\", \"v.shoulder\", \"v.elbow\"]",
        "time.max_episode_steps=100",
    ];
    let noise = ["noise={ v = \"0.01 * normal\" }", "time.max_episode_steps=100"];
    for (task, set) in [("Panda-reach", &[][..]), (two_link, &command[..]), (two_link, &noise[..])] {
        let set: Vec<String> = set.iter().map(|s: &&str| (*s).to_string()).collect();
        let snapshot = training(task, "pid2-ib", 3, 1, &set.iter().map(String::as_str).collect::<Vec<_>>())
            .snapshot()
            .clone();
        let (mut demos, _) = record(&snapshot, 3, 1).expect("episodes");
        let manifest = tasks::load(task, &set).expect("task");
        let mut env = env::of_task(&manifest, task).expect("environment");
        let period = manifest.task.time.dt * manifest.task.time.policy_every as f64;
        demos.check(&mut *env, period).unwrap_or_else(|e| panic!("{task} {set:?}: {e}"));
        let q = demos.names.iter().position(|n| n.starts_with("q.")).expect("a position");
        demos.episodes[1].observations[q] += 0.1;
        let error = demos.check(&mut *env, period).expect_err("another state");
        assert!(error.starts_with("episode 1 begins with q."), "{error}");
    }
}

/// Lengths whose sum is that of the rows once it has gone round 2^64.
#[test]
fn lengths_that_no_file_holds_are_refused() {
    let folder = tempfile::tempdir().expect("folder");
    let (file, _) = recorded(folder.path(), "Hopper-v5");
    let mut arrays = npz::read(&std::fs::read(&file).expect("bytes")).expect("arrays");
    let lengths = arrays.get_mut("lengths").expect("lengths");
    let Values::Numbers(of) = &mut lengths.values else { panic!("numbers") };
    let all: f64 = of.iter().sum();
    *of = vec![2_f64.powi(64) - 4096.0, all + 4096.0 + of.len() as f64 - 2.0];
    lengths.shape = vec![2];
    let parts: Vec<(&str, Array)> =
        arrays.iter().map(|(name, array)| (name.as_str(), array.clone())).collect();
    std::fs::write(&file, npz::write(&parts).unwrap()).expect("written");
    let said = Demonstrations::load(&file).expect_err("no such episode").to_string();
    assert!(
        said.contains("episode 0 has the length 18446744073709548000; give whole numbers of steps, 1 to 1e9"),
        "{said}"
    );
}

/// NumPy reads what is written here, and what NumPy writes is read here.
#[test]
fn numpy_reads_and_writes_the_same_file() {
    let folder = tempfile::tempdir().expect("folder");
    let (file, demos) = recorded(folder.path(), "Hopper-v5");
    let python = Path::new(env!("CARGO_MANIFEST_DIR")).join("../.venv/bin/python");
    let script = "import numpy, sys\nd = dict(numpy.load(sys.argv[1]))\nassert d['observations'].dtype == numpy.float64 and d['dt'].shape == ()\n\
                  d['lengths'] = d['lengths'].astype(numpy.int64)\nnumpy.savez(sys.argv[2], **d)\n\
                  d['qvel'] = d['qvel'].astype(numpy.float32)\nnumpy.savez_compressed(sys.argv[3], **d)";
    let [again, packed] = ["again.npz", "packed.npz"].map(|name| folder.path().join(name));
    let status =
        Command::new(python).args(["-c", script]).args([&file, &again, &packed]).status().expect("python");
    assert!(status.success());
    assert_eq!(Demonstrations::load(&again).expect("read"), demos);
    let error = Demonstrations::load(&packed).expect_err("compressed").to_string();
    assert!(error.contains("is compressed; write the file with numpy.savez"), "{error}");
}

#[test]
fn columns_are_found_by_name() {
    let folder = tempfile::tempdir().expect("folder");
    let (_, demos) = recorded(folder.path(), "Hopper-v5");
    let mut names = demos.names.clone();
    names.reverse();
    let turned = demos.columns(&names).expect("all there");
    let n = names.len();
    let rows =
        demos.episodes[0].observations.chunks_exact(n).zip(turned.episodes[0].observations.chunks_exact(n));
    assert!(rows.into_iter().all(|(a, b)| a.iter().eq(b.iter().rev())));
    let error = demos.columns(&["q.wing".to_string()]).expect_err("missing");
    assert!(error.starts_with("it has no column 'q.wing'; it has "), "{error}");
}

/// A file that was cut at any place is refused by its name, and nothing of it is read.
#[test]
fn a_file_cut_short_is_refused_by_name() {
    let folder = tempfile::tempdir().expect("folder");
    let (file, _) = recorded(folder.path(), "Hopper-v5");
    let whole = std::fs::read(&file).expect("file");
    for length in (0..200).chain((1..40).map(|k| k * whole.len() / 40)).chain([whole.len() - 1]) {
        std::fs::write(&file, &whole[..length]).expect("file");
        let error = Demonstrations::load(&file).expect_err("refused").to_string();
        assert!(error.contains("demos.npz") && error.contains("cut short"), "{length} bytes: {error}");
    }
}

type Arrays = std::collections::BTreeMap<String, Array>;

/// What somebody did to a file.
type Damage<'a> = &'a dyn Fn(&mut Arrays);

#[test]
fn bad_files_are_refused_by_array_column_and_episode() {
    let folder = tempfile::tempdir().expect("folder");
    let (file, demos) = recorded(folder.path(), "Hopper-v5");
    let whole = npz::read(&std::fs::read(&file).expect("file")).expect("arrays");
    let with = |edit: &dyn Fn(&mut Arrays)| {
        let mut arrays = whole.clone();
        edit(&mut arrays);
        let list: Vec<(&str, Array)> = arrays.iter().map(|(n, a)| (n.as_str(), a.clone())).collect();
        std::fs::write(&file, npz::write(&list).unwrap()).expect("file");
        Demonstrations::load(&file).expect_err("refused").to_string()
    };
    let numbers = |a: &mut Array, at: usize, x: f64| {
        let Values::Numbers(values) = &mut a.values else { panic!("numbers") };
        values[at] = x;
    };
    let (n, first) = (demos.names.len(), demos.episodes[0].length + 1);
    let error = with(&|a| numbers(a.get_mut("observations").expect("there"), (first + 2) * n + 4, f64::NAN));
    let want = format!("'observations' is NaN in episode 1, row 2, column '{}'", demos.names[4]);
    assert!(error.contains(&want) && error.contains("demos.npz"), "{error}");
    let error = with(&|a| numbers(a.get_mut("qvel").expect("there"), 1, -1e300));
    assert!(
        error.contains("'qvel' is -1e300 in episode 0, row 0, column '1'")
            && error.contains("leave the row out"),
        "{error}"
    );
    let cases: [(Damage, &str); 5] = [
        (&|a| drop(a.remove("qpos")), "has no array 'qpos'"),
        (&|a| numbers(a.get_mut("lengths").expect("there"), 1, 0.5), "episode 1 has the length 0.5"),
        (&|a| numbers(a.get_mut("lengths").expect("there"), 0, 1.0), "rows where 'lengths' asks for"),
        (&|a| numbers(a.get_mut("dt").expect("there"), 0, -1.0), "'dt' is -1"),
        (
            &|a| drop(a.insert("action".into(), a["dt"].clone())),
            "array 'action' is none that demonstrations have",
        ),
    ];
    for (edit, want) in cases {
        let error = with(edit);
        assert!(error.contains(want), "{error}");
    }
    let bytes = npz::write(&[("dt", Array { shape: vec![], values: Values::Numbers(vec![1.0]) })]).unwrap();
    for cut in 0..bytes.len() {
        assert!(npz::read(&bytes[..cut]).is_err(), "cut after {cut} bytes");
    }
    let mut flipped = bytes.clone();
    flipped[60] ^= 1;
    assert!(npz::read(&flipped).expect_err("damaged").contains("checksum"));
}
