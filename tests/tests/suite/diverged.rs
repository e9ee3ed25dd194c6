//! A training whose weights become no numbers ends, and what was before is kept.

use nearl_runtime::{Controller, Snapshot};
use nearl_tests::request;
use nearl_trainer::train::{Request, train};

#[test]
fn a_training_that_diverges_ends_and_keeps_the_weights_of_before() {
    for algo in ["ppo", "pid2-ib"] {
        let folder = tempfile::tempdir().expect("folder");
        let run = folder.path().join("run");
        let set = ["train.n_envs=4", "train.n_steps=160", "train.ppo.batch_size=320", "train.ppo.lr=1e30"];
        let request = Request { steps: 6400, ..request("Hopper-v5", algo, 5, 1, &set) };
        let mut rows = 0;
        let told = train(&request, &run, |_, _| {
            rows += 1;
            true
        });
        let told = told.expect_err("a refusal").to_string();
        assert!(told.contains("the training diverged after"), "{algo}: {told}");
        assert!(told.contains("tensor 'policy.") && told.contains("smaller train.ppo.lr"), "{algo}: {told}");
        assert!(rows < 10 && !run.join("checkpoints/final.safetensors").exists(), "{algo}: {rows} batches");
        let file = told.split('\'').find(|part| part.ends_with(".safetensors")).expect("a file");
        let snapshot = Snapshot::load(file.as_ref()).expect(file);
        Controller::new(&snapshot).expect("a controller of the weights before");
        assert_eq!(snapshot.manifest.steps, rows * 640, "{algo}");
    }
}
