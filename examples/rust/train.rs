//! Train PID²-IB on a task of one's own, look on, and use the policy.

use nearl_runtime::Controller;
use nearl_trainer::train::{Request, Training, complete};
use nearl_trainer::{rollout, tasks};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut manifest = tasks::load("examples/tasks/cart-pole.toml", &["train.n_steps=512".into()])?;
    complete(&mut manifest)?;
    let mut training =
        Training::new(&Request { manifest, algo: "pid2-ib".parse()?, steps: 16_384, seed: 0, threads: 2 })?;
    while let Some(progress) = training.try_iterate()? {
        println!("{:6} steps, return {:.1}", progress.steps, progress.return_mean);
        if training.is_done() {
            break;
        }
    }

    let snapshot = training.snapshot();
    let (mut controller, mut env) = (Controller::new(snapshot)?, rollout::make_env(snapshot)?);
    let (mut state, noise, mut out) = (controller.state(), controller.noise(), controller.output());
    env.reset(&mut rollout::stream(0, 0))?;
    let mut steps = 0;
    loop {
        env.state(&mut state.q, &mut state.v);
        env.observe(&mut state.obs);
        controller.update(&state, &noise, &mut out);
        steps += 1;
        if env.step(&out.action).terminated || steps == env.spec().max_episode_steps {
            break;
        }
    }
    println!("the pole stood for {steps} periods");
    Ok(())
}
