//! Same seed, same bits: whatever the threads, and in training as in deployment.

use nearl_runtime::{Controller, Snapshot};
use nearl_tests::training;
use nearl_trainer::rollout::{Worker, make_env, stream};

/// Record A = record B for one thread and two, over several updates of every algorithm.
#[test]
fn weights_do_not_depend_on_threads() {
    // a minibatch of 512 is cut among threads, one of 64 is not
    for (task, algo, minibatch) in [
        ("HalfCheetah-v5", "pid2-ib", 512),
        ("HalfCheetah-v5", "pid2-ib", 64),
        ("Hopper-v5", "ppo", 512),
        ("Hopper-v5", "ppo", 64),
        ("Panda-reach", "pid2-ib", 512),
    ] {
        let weights = |threads: usize, seed: u64| {
            let minibatch = format!("train.ppo.batch_size={minibatch}");
            let mut t = training(task, algo, seed, threads, &[&minibatch, "train.n_steps=64"]);
            for _ in 0..4 {
                t.iterate();
            }
            t.snapshot().to_bytes()
        };
        let one = weights(1, 3);
        assert!(one == weights(2, 3), "{task} {algo} {minibatch}: two threads gave other weights than one");
        assert!(one != weights(1, 4), "{task} {algo} {minibatch}: the seed changes nothing");
    }
}

/// A controller of a snapshot that went through a file gives the actions of one of the training's own, bit for bit.
#[test]
fn a_snapshot_survives_its_file() {
    for task in ["HalfCheetah-v5", "Panda-reach"] {
        let mut t = training(task, "pid2-ib", 0, 1, &["train.n_steps=64", "train.ppo.batch_size=512"]);
        (0..3).for_each(|_| drop(t.iterate()));
        let folder = tempfile::tempdir().expect("folder");
        let file = folder.path().join("s.safetensors");
        t.snapshot().save(&file).expect("save");
        let loaded = Snapshot::load(&file).expect("load");
        let (mut a, mut b) =
            (Controller::new(t.snapshot()).expect("a"), Controller::new(&loaded).expect("b"));
        let (mut env, mut state) = (make_env(&loaded).expect("env"), a.state());
        let (mut out_a, mut out_b, noise) = (a.output(), b.output(), a.noise());
        env.reset(&mut stream(5, 0)).expect("reset");
        for tick in 0..500 {
            env.observe(&mut state.obs);
            env.state(&mut state.q, &mut state.v);
            a.update(&state, &noise, &mut out_a);
            b.update(&state, &noise, &mut out_b);
            let bits = |x: &[f64]| x.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
            assert_eq!(bits(&out_a.action), bits(&out_b.action), "{task}, tick {tick}");
            assert_eq!(bits(&out_a.target), bits(&out_b.target), "{task}, tick {tick}");
            if env.step(&out_a.action).terminated {
                env.reset(&mut stream(6, 0)).expect("reset");
            }
        }
    }
}

/// An episode of the training's own worker, which got its networks from the learner, is one of a controller that loaded the snapshot's file.
#[test]
fn what_collects_is_what_is_deployed() {
    for (task, algo) in [("Hopper-v5", "pid2-ib"), ("HalfCheetah-v5", "ppo"), ("Panda-reach", "pid2-ib")] {
        let mut t = training(task, algo, 0, 1, &["train.n_steps=64", "train.ppo.batch_size=512"]);
        let first = t.snapshot().clone();
        let env = make_env(&first).expect("env");
        let mut worker = Worker::new(env, &first, 1.0, stream(3, 0)).expect("worker");
        (0..3).for_each(|_| drop(t.iterate()));
        worker.set_networks(&t.snapshot().networks);
        let (ret, steps) = worker.evaluate().expect("episode");

        let loaded = Snapshot::from_bytes(&t.snapshot().to_bytes()).expect("snapshot");
        let (mut env, mut controller) =
            (make_env(&loaded).expect("env"), Controller::new(&loaded).expect("controller"));
        let (mut state, mut out, noise) = (controller.state(), controller.output(), controller.noise());
        env.reset(&mut stream(3, 0)).expect("reset");
        // rewards are summed period by period, as there
        let (mut own, mut period, every) = (0.0, 0.0, controller.policy_every());
        let ticks = (1..=env.spec().max_episode_steps).find(|tick| {
            env.observe(&mut state.obs);
            env.state(&mut state.q, &mut state.v);
            controller.update(&state, &noise, &mut out);
            let step = env.step(&out.action);
            period += step.reward;
            let is_end = step.terminated || *tick == env.spec().max_episode_steps;
            if is_end || controller.begins_period() {
                own += std::mem::take(&mut period);
            }
            is_end
        });
        let ticks = ticks.expect("an end");
        assert_eq!(
            (ret.to_bits(), steps),
            (own.to_bits(), ticks.div_ceil(every)),
            "{task} {algo}: {ret} and {own}"
        );
        assert_ne!(t.snapshot().networks.policy.layers[0].weight, first.networks.policy.layers[0].weight);
    }
}

/// What a controller did before does not change its bits after a reset.
#[test]
fn history_does_not_matter() {
    let t = training("Panda-reach", "pid2-ib", 0, 1, &[]);
    let (mut fresh, mut used) =
        (Controller::new(t.snapshot()).expect("a"), Controller::new(t.snapshot()).expect("b"));
    let (mut state, noise) = (fresh.state(), fresh.noise());
    let (mut out_fresh, mut out_used) = (fresh.output(), used.output());
    for i in 0..1000 {
        state.v.iter_mut().for_each(|v| *v = f64::from(i % 13) * 0.1);
        state.obs[0] = if i % 7 == 0 { f64::NAN } else { 0.3 };
        used.update(&state, &noise, &mut out_used);
        assert!(out_used.action.iter().all(|a| a.is_finite()));
    }
    used.reset();
    let state = fresh.state();
    fresh.update(&state, &noise, &mut out_fresh);
    used.update(&state, &noise, &mut out_used);
    assert_eq!(out_fresh.action, out_used.action);
}
