//! Imitate: from recorded states, without a motor command, to a policy. Somebody balances a pole; PID²-IL learns it from five recordings.

use nearl_runtime::Controller;
use nearl_trainer::demos::{Demonstrations, Episode};
use nearl_trainer::train::{Request, Training, complete};
use nearl_trainer::{rollout, tasks};
use std::path::Path;

const TASK: &str = "examples/tasks/cart-pole.toml";

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let file = std::env::args().nth(1).unwrap_or("runs/pole.npz".into());
    let mut env = tasks::env(TASK)?;
    let mut obs = vec![0.0; env.spec().n_obs()];
    let mut episodes = Vec::new();
    for seed in 0..5 {
        // The recording: by hand-made gains here, in place of yours.
        env.reset(&mut rollout::stream(seed, 0))?;
        let mut episode = Episode { length: 250, ..Episode::default() };
        for k in 0..=episode.length {
            env.observe(&mut obs);
            episode.observations.extend_from_slice(&obs);
            episode.qpos.extend_from_slice(env.qpos());
            episode.qvel.extend_from_slice(env.qvel());
            let [x, hinge, v, w] = [env.qpos()[0], env.qpos()[1], env.qvel()[0], env.qvel()[1]];
            if k < episode.length {
                env.step(&[(0.3 * x + 0.5 * v + 5.0 * hinge + w).clamp(-1.0, 1.0)]);
            }
        }
        episodes.push(episode);
    }
    let names = env.spec().obs.clone();
    Demonstrations { names, dt: env.spec().dt, episodes }.save(Path::new(&file))?;

    let mut manifest = tasks::load(TASK, &[format!("train.demos.file='{file}'")])?;
    complete(&mut manifest)?;
    let mut training =
        Training::new(&Request { manifest, algo: "pid2-il".parse()?, steps: 40_000, seed: 0, threads: 2 })?;
    while !training.is_done() && training.try_iterate()?.is_some() {}

    let mut controller = Controller::new(training.snapshot())?;
    let (mut state, noise, mut out) = (controller.state(), controller.noise(), controller.output());
    env.reset(&mut rollout::stream(100, 0))?;
    let mut periods = 0;
    loop {
        env.state(&mut state.q, &mut state.v);
        env.observe(&mut state.obs);
        controller.update(&state, &noise, &mut out);
        periods += 1;
        if env.step(&out.action).terminated || periods == 500 {
            break;
        }
    }
    println!("the pole stood for {periods} periods of 500");
    Ok(())
}
