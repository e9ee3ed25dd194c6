//! Networks from the task file: sizes and activation, from training through the snapshot to the controller.

use nearl_runtime::net::{Activation, Dense, Forward, Function};
use nearl_runtime::{Controller, Snapshot, SnapshotError};
use nearl_tests::{request, training};
use nearl_trainer::train::Training;

const SETS: [&str; 5] = [
    "train.nets.policy=[24, 16, 8]",
    "train.nets.idm=[20]",
    "train.nets.value=[]",
    "train.nets.discriminator=[12, 10, 8]",
    "train.nets.activation=relu",
];
const SHORT: [&str; 3] = ["train.n_envs=4", "train.n_steps=32", "train.ppo.batch_size=64"];

/// The textbook sums with `max(0, x)` between the layers.
fn relu(net: &Dense, x: &[f32]) -> Vec<f64> {
    let mut h: Vec<f64> = x.iter().map(|&v| f64::from(v)).collect();
    for (i, l) in net.layers.iter().enumerate() {
        let sum = |n: usize| {
            let row = l.weight[n * l.n_in..][..l.n_in].iter().zip(&h);
            f64::from(l.bias[n]) + row.map(|(&w, x)| f64::from(w) * x).sum::<f64>()
        };
        let y: Vec<f64> = (0..l.n_out).map(sum).collect();
        h = if i + 1 < net.layers.len() { y.iter().map(|v| v.max(0.0)).collect() } else { y };
    }
    h
}

/// Sizes and activation of the task file reach the controller that loads the snapshot, for every algorithm.
#[test]
fn sizes_and_activation_survive_the_file() {
    let set = [SETS.as_slice(), SHORT.as_slice()].concat();
    for algo in ["ppo", "nearl", "pid2-gan", "pid2-ib"] {
        let mut t = training("HalfCheetah-v5", algo, 0, 1, &set);
        (0..3).for_each(|_| drop(t.iterate()));
        let loaded = Snapshot::from_bytes(&t.snapshot().to_bytes()).expect("loads");
        assert_eq!(loaded.manifest.activation, Activation::Relu);
        let (n_out, nets) = (if algo == "ppo" { 6 } else { 17 }, &loaded.networks);
        assert_eq!(nets.policy.widths(), [17, 24, 16, 8, n_out]);
        let idm = nets.idm.as_ref().map(|(net, _)| net.widths());
        assert_eq!(idm, (algo != "ppo").then(|| vec![24, 20, 6]));
        let mut controller = Controller::new(&loaded).expect("controller");
        let (mut state, mut out) = (controller.state(), controller.output());
        state.obs.iter_mut().enumerate().for_each(|(i, x)| *x = (i as f64).sin());
        controller.update(&state, &controller.noise(), &mut out);
        let want = relu(&nets.policy, &out.x);
        let got = if algo == "ppo" { &out.sampled } else { &out.change };
        for (g, w) in got.iter().zip(want) {
            assert!((f64::from(*g) - w).abs() < 1e-5 * (1.0 + w.abs()), "{algo}: {g} {w}");
        }
    }
}

/// The manifest is edited as a vandal would, digest included.
fn with_manifest(snapshot: &Snapshot, from: &str, to: &str) -> Result<Snapshot, SnapshotError> {
    let bytes = snapshot.to_bytes();
    let head = u64::from_le_bytes(bytes[..8].try_into().expect("8 bytes")) as usize;
    let mut header: serde_json::Value = serde_json::from_slice(&bytes[8..8 + head]).expect("header");
    let text = header["__metadata__"]["nearl"].as_str().expect("text").to_owned();
    let (_, manifest) = text.split_once('\n').expect("digest and manifest");
    assert!(manifest.contains(from), "{manifest}");
    let manifest = manifest.replace(from, to);
    let write = |digest: &str, header: &mut serde_json::Value| {
        header["__metadata__"]["nearl"] = format!("{digest}\n{manifest}").into();
        let head = header.to_string();
        [&(head.len() as u64).to_le_bytes(), head.as_bytes(), &bytes[8 + bytes_head(&bytes)..]].concat()
    };
    // a wrong digest is answered with the right one
    match Snapshot::from_bytes(&write("0", &mut header)) {
        Err(SnapshotError::Digest { actual, .. }) => Snapshot::from_bytes(&write(&actual, &mut header)),
        other => other,
    }
}

fn bytes_head(bytes: &[u8]) -> usize {
    u64::from_le_bytes(bytes[..8].try_into().expect("8 bytes")) as usize
}

#[test]
fn an_unknown_activation_is_refused_and_an_absent_one_is_tanh() {
    let t = training("Panda-reach", "pid2-ib", 0, 1, &[]);
    let refused = with_manifest(t.snapshot(), "\"activation\":\"tanh\"", "\"activation\":\"gelu\"");
    let error = refused.expect_err("gelu is not known").to_string();
    assert!(error.contains("gelu") && error.contains("tanh") && error.contains("relu"), "{error}");
    let old = with_manifest(t.snapshot(), "\"activation\":\"tanh\",", "").expect("an older file");
    assert_eq!(old.manifest.activation, Activation::Tanh);
    assert_eq!(old.networks, t.snapshot().networks);
}

/// The format of a file, as its manifest says.
fn format_of(snapshot: &Snapshot) -> u64 {
    let bytes = snapshot.to_bytes();
    let header: serde_json::Value =
        serde_json::from_slice(&bytes[8..8 + bytes_head(&bytes)]).expect("header");
    let text = header["__metadata__"]["nearl"].as_str().expect("text");
    let manifest = text.split_once('\n').expect("digest and manifest").1;
    serde_json::from_str::<serde_json::Value>(manifest).expect("manifest")["format"].as_u64().expect("format")
}

/// A program that knows format 2 alone reads no linear part beside the layers: it has to refuse the file.
#[test]
fn a_linear_part_beside_the_layers_is_of_a_later_format() {
    let nets = ["train.nets.idm=[8]", "train.nets.idm_residual=true"];
    let plain = training("HalfCheetah-v5", "pid2-ib", 0, 1, &nets[..1]);
    let beside = training("HalfCheetah-v5", "pid2-ib", 0, 1, &nets);
    assert_eq!((format_of(plain.snapshot()), format_of(beside.snapshot())), (2, 3));
    let loaded = Snapshot::from_bytes(&beside.snapshot().to_bytes()).expect("loads");
    assert_eq!(loaded.networks, beside.snapshot().networks);
    assert!(loaded.networks.idm.as_ref().is_some_and(|(net, _)| net.skip.is_some()));
    assert_eq!(loaded.to_bytes(), beside.snapshot().to_bytes());
    let earlier = with_manifest(beside.snapshot(), "\"format\":3", "\"format\":2").expect("written before");
    assert_eq!(earlier.networks, loaded.networks);
    let later = with_manifest(beside.snapshot(), "\"format\":3", "\"format\":4").expect_err("unknown");
    assert!(later.to_string().contains("format 4 where this program reads 1 to 3"), "{later}");
}

#[test]
fn a_manifest_that_no_task_file_could_give_is_refused() {
    let t = training("Panda-reach", "pid2-ib", 0, 1, &[]);
    for (from, to, words) in [
        ("\"policy_every\":20", "\"policy_every\":0", "policy_every"),
        ("\"action_lower\":[-87.0", "\"action_lower\":[88.0", "an action range from 88 to 87"),
    ] {
        let error = with_manifest(t.snapshot(), from, to).expect_err(words).to_string();
        assert!(error.contains(words), "{error}");
    }
}

#[test]
fn impossible_sizes_are_refused_in_a_sentence() {
    for (set, word) in [
        ("train.nets.policy=[32, 0]", "[train.nets.policy]: a hidden layer of width 0"),
        ("train.nets.idm=[100000]", "[train.nets.idm]"),
        ("train.nets.activation=gelu", "gelu"),
        ("train.nets.polcy=[3]", "did you mean 'policy'"),
    ] {
        let error = Training::new(&request("HalfCheetah-v5", "pid2-ib", 0, 1, &[set])).map(|_| ());
        let error = error.expect_err(set).to_string();
        assert!(error.contains(word), "{set}: {error}");
    }
}

/// A function after each layer and clips of the inputs survive the file and reach the controller; a file that says too few is refused.
#[test]
fn functions_of_layers_and_clips_survive_the_file() {
    let t = training("HalfCheetah-v5", "ppo", 0, 1, &SHORT);
    let mut snapshot = t.snapshot().clone();
    assert_eq!(
        Snapshot::from_bytes(&snapshot.to_bytes()).expect("loads").networks.normaliser.clip,
        Vec::<[f64; 2]>::new()
    );
    let functions = [Function::Elu, Function::Silu, Function::Tanh];
    snapshot.manifest.functions = functions.to_vec();
    let n = snapshot.networks.normaliser.mean.len();
    snapshot.networks.normaliser.clip = (0..n).map(|i| [-0.1 * i as f64, f64::INFINITY]).collect();
    let loaded = Snapshot::from_bytes(&snapshot.to_bytes()).expect("loads");
    assert_eq!(loaded.manifest.functions, functions);
    assert_eq!(loaded.networks, snapshot.networks);
    let mut controller = Controller::new(&loaded).expect("controller");
    let (mut state, mut out) = (controller.state(), controller.output());
    state.obs.iter_mut().enumerate().for_each(|(i, x)| *x = 20.0 * (i as f64).sin());
    controller.update(&state, &controller.noise(), &mut out);
    for (i, &x) in out.x.iter().enumerate() {
        let norm = &loaded.networks.normaliser;
        let want = ((state.obs[i] - norm.mean[i]) / norm.std[i]).max(-0.1 * i as f64);
        assert_eq!(x, want as f32);
    }
    let want = Forward::layered(&loaded.networks.policy, functions.to_vec()).forward(&out.x).to_vec();
    assert_eq!(out.sampled, want);

    snapshot.manifest.functions.pop();
    let refused = Snapshot::from_bytes(&snapshot.to_bytes()).unwrap_err();
    assert!(refused.to_string().contains("functions after 2 layers of a policy that has 3"), "{refused}");
    snapshot.manifest.functions.clear();
    snapshot.networks.normaliser.clip[3] = [1.0, f64::NAN];
    let refused = Snapshot::from_bytes(&snapshot.to_bytes()).unwrap_err();
    assert!(matches!(refused, SnapshotError::Value { index: 3, .. }), "{refused}");
}
