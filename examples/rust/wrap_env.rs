//! Environments of a task, and some whose action is a proposed state that is projected inside.

use nearl_trainer::rollout::stream;
use nearl_trainer::vector::{Autoreset, Constraints, Meaning, Settings, Vector};
use rand::RngExt;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let plain = Settings {
        num_envs: 4,
        constraints: None,
        actions: Meaning::Change,
        seed: 0,
        threads: 2,
        max_episode_steps: None,
        autoreset: Autoreset::NextStep,
    };
    let mut rng = stream(0, 0);
    let mut cheetahs = Vector::new("HalfCheetah-v5", &plain)?;
    cheetahs.reset(None)?;
    let mut total = 0.0;
    for _ in 0..100 {
        let torques: Vec<f64> = (0..4 * 6).map(|_| rng.random_range(-1.0..1.0)).collect();
        cheetahs.step(&torques)?;
        total += cheetahs.lanes().map(|lane| lane.reward).sum::<f64>();
    }
    println!("HalfCheetah, random torques: return of 100 steps {:.1}", total / 4.0);

    let mut arms = Vector::new("Panda-reach", &Settings { constraints: Some(Constraints::Task), ..plain })?;
    arms.reset(None)?;
    let (mut raw, mut targets) = (0, 0);
    for _ in 0..50 {
        let n = arms.n() * arms.action_names().len();
        let proposals: Vec<f64> = (0..n).map(|_| rng.random_range(-4.0..4.0)).collect(); // careless on purpose
        arms.step(&proposals)?;
        for lane in arms.lanes() {
            raw += lane.tally.raw_violations;
            targets += lane.tally.target_violations;
        }
    }
    println!("Panda: {raw} proposals outside the limits, {targets} targets");
    assert_eq!(targets, 0);
    Ok(())
}
