//! What crosses crates: conformance, parity, determinism, allocation. Shared pieces of the tests.

use nearl_runtime::net::{Dense, DenseLayer};
use nearl_runtime::{PolicyKind, Snapshot};
use nearl_trainer::train::{Request, Training, complete};
use nearl_trainer::{rollout, tasks};
use rand::RngExt;

/// A training of a bundled task with overrides.
///
/// # Panics
/// When the task or an override is refused.
pub fn training(task: &str, algo: &str, seed: u64, threads: usize, set: &[&str]) -> Training {
    Training::new(&request(task, algo, seed, threads, set)).unwrap_or_else(|e| panic!("{task}: {e}"))
}

/// What [`training`] asks for.
///
/// # Panics
/// As [`training`].
pub fn request(task: &str, algo: &str, seed: u64, threads: usize, set: &[&str]) -> Request {
    let set: Vec<String> = set.iter().map(|s| (*s).to_string()).collect();
    let mut manifest = tasks::load(task, &set).unwrap_or_else(|e| panic!("{task}: {e}"));
    complete(&mut manifest).unwrap_or_else(|e| panic!("{task}: {e}"));
    let algo = algo.parse().unwrap_or_else(|e| panic!("{e}"));
    Request { manifest, algo, steps: 1_000_000, seed, threads }
}

/// A snapshot of the task whose policy is a random network with weights of size `gain`: the worst policy there is.
///
/// # Panics
/// As [`training`].
pub fn random_policy(task: &str, seed: u64, gain: f32) -> Snapshot {
    let mut snapshot = training(task, "pid2-ib", seed, 1, &[]).snapshot().clone();
    let mut rng = rollout::stream(seed, 7);
    let mut weight =
        |n: usize| (0..n).map(|_| gain * (2.0 * rng.random::<f32>() - 1.0)).collect::<Vec<f32>>();
    let networks = &mut snapshot.networks;
    let layers = networks.policy.layers.iter().map(|l| DenseLayer {
        n_in: l.n_in,
        n_out: l.n_out,
        weight: weight(l.n_in * l.n_out),
        bias: weight(l.n_out),
    });
    networks.policy = Dense { layers: layers.collect(), skip: None };
    assert_ne!(snapshot.manifest.policy, PolicyKind::Direct);
    snapshot
}
