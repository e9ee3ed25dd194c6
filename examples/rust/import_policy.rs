//! A policy that somebody else trained, behind limits: Stable-Baselines3 on Gymnasium's Reacher, exported to ONNX by PyTorch.

use nearl_runtime::Controller;
use nearl_trainer::import::{Setting, read, snapshot};
use nearl_trainer::rollout;
use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = Path::new("examples/policies");
    let network = read(&folder.join("reacher.onnx"), None)?;
    let recipe = folder.join("reacher.toml"); // what it sees, what its outputs mean, and the limits
    let made = snapshot(
        &network,
        &Setting { name: "reacher", robot: &folder.join("reacher.xml"), recipes: &[recipe] },
    )?;
    println!("{} inputs, layers {:?}", network.n_in(), &network.dense.widths()[1..]);

    for guarded in [false, true] {
        let (mut controller, mut env) = (Controller::new(&made)?, rollout::make_env(&made)?);
        controller.set_projection(guarded);
        let (mut state, noise, mut out) = (controller.state(), controller.noise(), controller.output());
        let (mut fastest, mut closest) = (0.0_f64, f64::INFINITY);
        for seed in 0..10 {
            env.reset(&mut rollout::stream(seed, 0))?;
            controller.reset();
            for _ in 0..env.spec().max_episode_steps {
                env.state(&mut state.q, &mut state.v);
                env.observe(&mut state.obs);
                controller.update(&state, &noise, &mut out);
                env.step(&out.action);
                fastest = env.qvel()[..2].iter().fold(fastest, |most, v| most.max(v.abs()));
                closest = closest.min(state.obs[10].hypot(state.obs[11]));
            }
        }
        let how = if guarded { "behind its limits" } else { "as it is" };
        println!(
            "{how}: fastest joint {fastest:.2} rad/s of 2 allowed, tip as near as {:.0} mm",
            1e3 * closest
        );
        assert!(!guarded || fastest <= 2.001);
    }
    Ok(())
}
