//! A training that starts from the networks of another one.

use nearl_tests::request;
use nearl_trainer::train::{Experience, Request, Training, resume, train, train_in};
use std::path::{Path, PathBuf};

const BATCH: u64 = 4 * 160;

fn asked(task: &str, algo: &str, seed: u64, batches: u64, more: &[&str]) -> Request {
    let set = ["train.n_envs=4", "train.n_steps=160", "train.ppo.batch_size=320", "train.ppo.n_epochs=2"];
    let set = [set.as_slice(), more].concat();
    Request { steps: batches * BATCH, ..request(task, algo, seed, 2, &set) }
}

/// A finished run of the request.
fn run(folder: &Path, name: &str, request: &Request) -> PathBuf {
    let run = folder.join(name);
    train(request, &run, |_, _| true).expect("a run");
    run
}

fn start(request: &Request, run: &Path) -> Result<Training, String> {
    Training::start_from(request, &Experience::Here, run).map_err(|e| e.to_string())
}

/// The networks are those of the run, under other limits and with another seed; then they learn, with no second warm-up.
#[test]
fn a_training_starts_where_another_one_ended() {
    let folder = tempfile::tempdir().expect("folder");
    for (algo, more) in [("pid2-ib", "train.pid2.warmup=1280"), ("ppo", "train.gamma=0.99")] {
        let source = run(folder.path(), algo, &asked("Hopper-v5", algo, 5, 6, &[more]));
        let others = [more, "constraints.velocity.limit=7.0"];
        let request = asked("Hopper-v5", algo, 6, 4, &others);
        let mut training = start(&request, &source).expect("it fits");
        let theirs =
            nearl_runtime::Snapshot::load(&source.join("checkpoints/final.safetensors")).expect("final");
        let ours = training.snapshot().clone();
        assert_eq!(ours.networks, theirs.networks, "{algo}");
        assert_ne!(ours.manifest.task.constraints, theirs.manifest.task.constraints);
        assert_eq!((ours.manifest.steps, ours.manifest.version), (0, 0));
        // the first batch fills statistics, the second is learned from, without a warm-up
        training.iterate();
        assert_eq!(training.snapshot().networks.policy, theirs.networks.policy, "{algo}");
        let progress = training.iterate();
        assert_ne!(training.snapshot().networks.policy, theirs.networks.policy, "{algo}");
        assert!(progress.metrics.iter().any(|(name, _)| *name == "train/policy_gradient_loss"), "{algo}");
    }
}

/// Stopped within what would have been its warm-up, such a run goes on to the same weights.
#[test]
fn a_run_that_started_from_another_resumes_bit_for_bit() {
    let folder = tempfile::tempdir().expect("folder");
    let more = ["train.pid2.warmup=1920"];
    let source = run(folder.path(), "source", &asked("Hopper-v5", "pid2-ib", 5, 6, &more));
    let request = asked("Hopper-v5", "pid2-ib", 6, 5, &more);
    let whole = folder.path().join("whole");
    train_in(&whole, start(&request, &source).expect("it fits"), |_, _| true).expect("a run");
    let parts = folder.path().join("parts");
    let mut left = 2;
    let two = |_: &_, _| {
        left -= 1;
        left > 0
    };
    train_in(&parts, start(&request, &source).expect("it fits"), two).expect("a part");
    std::fs::remove_dir_all(&source).expect("nothing more is read of it");
    resume(&parts, None, 1, |_, _| true).expect("the rest");
    let last = |run: &Path| std::fs::read(run.join("checkpoints/final.safetensors")).expect("final");
    assert!(last(&whole) == last(&parts), "other weights after resuming");
}

/// Another algorithm with the same policy takes policy, inverse model and value, and begins with networks of its own beside them.
#[test]
fn an_algorithm_goes_on_with_the_policy_of_another() {
    let folder = tempfile::tempdir().expect("folder");
    let source = run(folder.path(), "nearl", &asked("Hopper-v5", "nearl", 5, 4, &[]));
    let training = start(&asked("Hopper-v5", "pid2-gan", 6, 4, &[]), &source).expect("it fits");
    let theirs = nearl_runtime::Snapshot::load(&source.join("checkpoints/final.safetensors")).expect("final");
    assert_eq!(training.snapshot().networks, theirs.networks);
}

#[test]
fn what_does_not_fit_is_refused_by_name() {
    let folder = tempfile::tempdir().expect("folder");
    let source = run(folder.path(), "source", &asked("Hopper-v5", "pid2-ib", 5, 2, &[]));
    for (request, sentence) in [
        (
            asked("Walker2d-v5", "pid2-ib", 6, 2, &[]),
            "entry 5 of the observation is 'v.rootx' there and 'q.thigh_left_joint' here",
        ),
        (
            asked("Hopper-v5", "ppo", 6, 2, &[]),
            "one of states that explores in its actions there and one of 'ppo' is one of actions here",
        ),
        (
            asked("Hopper-v5", "pid2-ib", 6, 2, &["train.nets.policy=[16]"]),
            "[train.nets] has another policy ([32, 32] there, [16] here)",
        ),
        (
            asked("Hopper-v5", "pid2-ib", 6, 2, &["train.pid2.warmup=640"]),
            "that of 'pid2-ib' was 0 steps where 'pid2-ib' has 640; set train.pid2.warmup=0",
        ),
        (asked("Hopper-v5", "pid2-ib", 6, 2, &["train.normalise_obs=false"]), "train.normalise_obs"),
        (asked("Hopper-v5", "pid2-ib", 6, 2, &["idm.input=full"]), "the inverse model sees other entries"),
    ] {
        let refusal = start(&request, &source).err().expect("refused");
        assert!(
            refusal.starts_with("start_from: the networks of '") && refusal.contains(sentence),
            "{refusal}"
        );
    }
    let arm = run(folder.path(), "arm", &asked("Panda-reach", "pid2-ib", 5, 1, &[]));
    let refusal = start(&asked("Panda-reach", "pid2-ib", 6, 1, &["time.policy_every=10"]), &arm)
        .err()
        .expect("refused");
    assert!(refusal.contains("its policy runs every 0.02 s, and every 0.01 s here"), "{refusal}");
    let nowhere = start(&asked("Hopper-v5", "pid2-ib", 6, 2, &[]), folder.path()).err().expect("refused");
    assert!(nowhere.contains("is no run folder with something learned"), "{nowhere}");
}

/// A spread other than the run's is meant; the same one goes on as it was learned.
#[test]
fn a_spread_that_is_asked_for_is_taken() {
    let folder = tempfile::tempdir().expect("folder");
    for algo in ["pid2-ib", "ppo"] {
        let source = run(folder.path(), algo, &asked("Hopper-v5", algo, 5, 6, &[]));
        let spread = |more: &[&str]| {
            let training = start(&asked("Hopper-v5", algo, 6, 4, more), &source).expect("it fits");
            let networks = &training.snapshot().networks;
            networks.idm.as_ref().map_or(networks.policy_log_std.clone(), |(_, spread)| spread.clone())
        };
        assert!(spread(&[]).iter().all(|x| *x != 0.0 && x.abs() < 0.5), "{algo}: {:?}", spread(&[]));
        assert_eq!(spread(&["train.ppo.log_std=-1.5"]), [-1.5; 3], "{algo}");
    }
}

/// Where it came from stands in the run folder.
#[test]
fn a_run_names_what_it_started_from() {
    let folder = tempfile::tempdir().expect("folder");
    let source = run(folder.path(), "source", &asked("Hopper-v5", "ppo", 5, 2, &[]));
    let out = folder.path().join("out");
    let training = start(&asked("Hopper-v5", "ppo", 6, 2, &[]), &source).expect("it fits");
    train_in(&out, training, |_, _| true).expect("a run");
    let about: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(out.join("env.json")).expect("env.json"))
            .expect("JSON");
    assert_eq!(about["start_from"]["run"], source.display().to_string());
    assert_eq!(
        (&about["start_from"]["steps"], &about["start_from"]["algo"]),
        (&(2 * BATCH).into(), &"ppo".into())
    );
    assert_eq!((&about["algo"], &about["seed"]), (&"ppo".into(), &6.into()));
}
