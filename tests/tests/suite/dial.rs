//! `[constraints] reached`: the share of ticks that end outside, in training, in files and where it can mean nothing.

use nearl_runtime::doctor::Finding;
use nearl_runtime::{Controller, Snapshot};
use nearl_tests::training;
use nearl_trainer::rollout::{make_env, stream};
use nearl_trainer::tasks;

const ASKED: &str = "constraints.reached=0.05";
const SHORT: [&str; 4] =
    ["train.n_envs=8", "train.n_steps=64", "train.ppo.batch_size=128", "train.nets.idm_residual=true"];

fn trained(threads: usize, set: &[&str]) -> Snapshot {
    let mut t = training("HalfCheetah-v5", "pid2-ib", 3, threads, &[&SHORT[..], set].concat());
    (0..4).for_each(|_| drop(t.iterate()));
    t.snapshot().clone()
}

/// Margins are learned in each environment and merged in a fixed order: any number of threads gives the same file.
#[test]
fn margins_do_not_depend_on_threads() {
    let one = trained(1, &[ASKED]);
    assert!(one.to_bytes() == trained(2, &[ASKED]).to_bytes(), "two threads gave another snapshot than one");
    assert!(one.networks.policy != trained(1, &[]).networks.policy, "the margins changed nothing");
}

/// A trained policy comes with its margins; its file has them bit for bit, and a controller of it begins with them.
#[test]
fn a_snapshot_has_its_margins() {
    let snapshot = trained(2, &[ASKED]);
    let loaded = Snapshot::from_bytes(&snapshot.to_bytes()).expect("snapshot");
    let bits = |x: &[f64]| x.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
    assert_eq!(bits(&loaded.networks.margins), bits(&snapshot.networks.margins));
    let controller = Controller::new(&loaded).expect("controller");
    assert_eq!(bits(&controller.learned_margins()), bits(&loaded.networks.margins));
    let margins = controller.margins();
    assert_eq!(margins.len(), 12, "two rows a joint");
    assert!(margins.iter().any(|m| m.share > 0.0), "{margins:?}");
    let ticks = loaded.networks.margins[1];
    assert!(
        ticks > 200.0 && ticks <= 256.0,
        "4 segments of 64 ticks in each environment, fewer where it began: {ticks}"
    );
}

/// A loop swaps between a snapshot that asks for a share and one that does not: what both know is handed on.
#[test]
fn a_swap_to_margins_or_from_them_keeps_the_way_to_stop() {
    let with = trained(1, &[ASKED, "constraints.acceleration.limit=200.0", "constraints.braking=stored"]);
    let mut without = with.clone();
    without.manifest.task.constraints.reached = None;
    without.networks.margins.clear();
    let controller = |snapshot: &Snapshot| Controller::new(snapshot).expect("controller");
    for (from, to) in [(&with, &without), (&without, &with)] {
        let (mut from, mut to) = (controller(from), controller(to));
        let (mut state, noise, mut out) = (from.state(), from.noise(), from.output());
        state.v[3] = 0.5;
        from.update(&state, &noise, &mut out);
        let brake = from.stored_brake().map(<[f64]>::to_vec);
        assert!(brake.is_some(), "a way to stop was stored");
        assert!(!to.take_memory(&from.memory()), "the margins are not of both");
        assert_eq!(to.stored_brake().map(<[f64]>::to_vec), brake);
        assert!(!to.take_memory(&from.memory()[1..]), "no memory");
    }
}

/// Doctor says what is asked and what was learned, and names the limit at which a motor has no more to give.
#[test]
fn doctor_says_what_is_asked_and_where_it_cannot_be_had() {
    let mut snapshot = trained(1, &[ASKED]);
    let folder = tempfile::tempdir().expect("a folder");
    let said = |snapshot: &Snapshot| {
        let file = folder.path().join("policy.safetensors");
        snapshot.save(&file).expect("saved");
        let checks = nearl_runtime::doctor::examine(&file, None);
        let check = checks.into_iter().find(|check| check.check == "reached").expect("a check of the share");
        (check.finding, check.text)
    };
    let (finding, text) = said(&snapshot);
    assert!(finding == Finding::Ok && text.starts_with("5.000 % of ticks"), "{text}");
    let last = snapshot.networks.margins.len() - 1;
    snapshot.networks.margins[last] = 1.0;
    let (finding, text) = said(&snapshot);
    assert!(finding == Finding::Warn && text.contains("the upper limit of joint 'ffoot'"), "{text}");
}

/// Whoever takes over in the middle of an episode goes on with the margins, bit for bit; an episode's end leaves them.
#[test]
fn margins_are_handed_on_and_outlast_episodes() {
    let snapshot = trained(1, &[ASKED]);
    let controller = || Controller::new(&snapshot).expect("controller");
    let (mut a, mut b) = (controller(), controller());
    let mut env = make_env(&snapshot).expect("env");
    let (mut state, noise, mut out_a, mut out_b) = (a.state(), a.noise(), a.output(), b.output());
    env.reset(&mut stream(5, 0)).expect("reset");
    for tick in 0..600 {
        env.observe(&mut state.obs);
        env.state(&mut state.q, &mut state.v);
        if tick == 300 {
            assert!(b.take_memory(&a.memory()));
        }
        a.update(&state, &noise, &mut out_a);
        if tick >= 300 {
            b.update(&state, &noise, &mut out_b);
            let bits = |x: &[f64]| x.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
            assert_eq!(bits(&out_a.action), bits(&out_b.action), "tick {tick}");
            assert_eq!(bits(&a.learned_margins()), bits(&b.learned_margins()), "tick {tick}");
        }
        env.step(&out_a.action);
    }
    let learned = a.learned_margins();
    assert_ne!(learned, snapshot.networks.margins);
    a.reset();
    assert_eq!(a.learned_margins(), learned, "an episode's end");
    a.forget_margins();
    assert_eq!(a.learned_margins(), snapshot.networks.margins);
}

/// What was asked for is reached on the simulator's own states by random policies that lean on their stops, as far as their motors can. One in
/// fifty cannot be had of the wilder one: margins are at their end then.
#[test]
fn the_share_asked_for_is_reached_in_the_simulator() {
    // the share outside, and rows whose margin is at its end
    let outside = |set: &[&str], log_std: f32| {
        let mut snapshot = trained(1, set);
        let (_, spread) = snapshot.networks.idm.as_mut().expect("an inverse model");
        spread.fill(log_std);
        let mut env = make_env(&snapshot).expect("env");
        let mut controller = Controller::new(&snapshot).expect("controller");
        let (mut state, mut noise, mut out) = (controller.state(), controller.noise(), controller.output());
        let mut rng = stream(9, 0);
        let (mut count, settling, counted) = (0, 30_000, 30_000);
        for tick in 0..settling + counted {
            if tick % 1000 == 0 {
                env.reset(&mut rng).expect("reset");
                controller.reset();
            }
            env.observe(&mut state.obs);
            env.state(&mut state.q, &mut state.v);
            noise.draw(7, tick);
            controller.update(&state, &noise, &mut out);
            env.step(&out.action);
            env.state(&mut state.q, &mut state.v);
            count += u32::from(tick >= settling && controller.excess(&state)[0].is_some());
        }
        let at_end = controller.margins().iter().filter(|m| m.at_end).count();
        (f64::from(count) / counted as f64, at_end)
    };
    for (asked, log_std) in [(0.1, 0.0), (0.05, -0.5)] {
        let (without, _) = outside(&[], log_std);
        let (with, _) = outside(&[&format!("constraints.reached={asked}")], log_std);
        assert!(without > 1.5 * asked, "{without}: the test could not fail");
        assert!((with / asked - 1.0).abs() < 0.15, "asked for {asked}, got {with}, and {without} without");
    }
    let (with, at_end) = outside(&["constraints.reached=0.02"], 0.0);
    assert!(with > 0.03 && at_end > 0, "got {with} with {at_end} margins at their end");
}

/// A training that was saved goes on bit for bit, its margins too.
#[test]
fn margins_survive_a_checkpoint() {
    let set = [&SHORT[..], &[ASKED]].concat();
    let mut whole = training("HalfCheetah-v5", "pid2-ib", 3, 1, &set);
    (0..2).for_each(|_| drop(whole.iterate()));
    let saved = whole.checkpoint().expect("checkpoint");
    let file = std::path::Path::new("test");
    let mut resumed = nearl_trainer::train::Training::resume(saved, file, None, 1).expect("resumed");
    assert!(resumed.snapshot().to_bytes() == whole.snapshot().to_bytes(), "saved and resumed");
    for t in [&mut whole, &mut resumed] {
        (0..2).for_each(|_| drop(t.iterate()));
    }
    assert!(resumed.snapshot().to_bytes() == whole.snapshot().to_bytes(), "two iterations later");
}

#[test]
fn a_share_that_can_mean_nothing_is_refused_in_a_sentence() {
    let refuse = |task: &str, algo: &str, set: &[&str]| {
        let set: Vec<String> = set.iter().map(|s| (*s).to_string()).collect();
        let mut manifest = match tasks::load(task, &set) {
            Ok(manifest) => manifest,
            Err(e) => return e.to_string(),
        };
        if let Err(e) = nearl_trainer::train::complete(&mut manifest) {
            return e.to_string();
        }
        let algo = algo.parse().expect("an algorithm");
        let request = nearl_trainer::train::Request { manifest, algo, steps: 1000, seed: 0, threads: 1 };
        nearl_trainer::train::Training::new(&request).map(|_| ()).expect_err("refused").to_string()
    };
    for (task, algo, set, needle) in [
        ("HalfCheetah-v5", "pid2-ib", vec!["constraints.reached=0.0"], "above 0 and below 1"),
        ("HalfCheetah-v5", "pid2-ib", vec!["constraints.reached=1.0"], "above 0 and below 1"),
        ("HalfCheetah-v5", "pid2-ib", vec!["constraints.reached=nan"], "NaN is not finite"),
        ("HalfCheetah-v5", "ppo", vec![ASKED, "constraints.guard=\"simulator\""], "leave one of the two out"),
        ("Panda-reach", "pid2-ib", vec![ASKED], "idm.kind = \"pinocchio\""),
        (
            "HalfCheetah-v5",
            "pid2-ib",
            vec!["constraints={ consistency = \"free\", velocity = { limit = 25.0 }, reached = 0.05 }"],
            "add position = {}",
        ),
    ] {
        let text = refuse(task, algo, &set);
        assert!(text.contains(needle) && text.contains("reached"), "{task} {set:?}: {text}");
    }
}
