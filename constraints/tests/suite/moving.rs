//! Limits that move while the robot does: what is declared of the way holds under attack, and the way is as fast as it can be.

mod claims;
mod elsewhere;
mod joints;

use nearl_constraints::*;

use crate::common::*;

const SUB_STEPS: [u32; 3] = [0, 1, 5];
const PERIODS: [f64; 4] = [0.001, 0.002, 0.01, 0.02];

fn moved() -> Moved {
    Moved::default()
}

fn by_joint(model: &Model, value: impl Fn(usize) -> f64) -> Option<PerJoint> {
    Some(PerJoint::Each((0..model.nv()).map(value).collect()))
}

fn joints(acceleration: f64, torque: Option<f64>) -> Vec<Box<dyn Limit>> {
    let mut limits: Vec<Box<dyn Limit>> = vec![
        Box::new(PositionLimit::default()),
        Box::new(VelocityLimit::default()),
        Box::new(AccelerationLimit::uniform(acceleration)),
    ];
    limits.extend(torque.map(|scale| Box::new(TorqueLimit::scaled(scale)) as Box<dyn Limit>));
    limits
}

fn middle(model: &Model) -> Vec<f64> {
    let (low, high) = (model.lower_position_limit(), model.upper_position_limit());
    (0..model.nv()).map(|i| 0.5 * (low[i] + high[i])).collect()
}

/// What was asked for last, as a test reads it.
struct Asked {
    speed: Vec<f64>,
    gain: Vec<f64>,
    lower: Vec<f64>,
    upper: Vec<f64>,
}

/// Limits of single joints at random, tighter and looser again.
fn draw(model: &Model, acceleration: f64, random: &mut Random) -> (Moved, Asked) {
    let (low, high) = (model.lower_position_limit(), model.upper_position_limit());
    let n = model.nv();
    let mut asked = Asked {
        speed: model.velocity_limit().to_vec(),
        gain: vec![acceleration; n],
        lower: low.to_vec(),
        upper: high.to_vec(),
    };
    let mut moved = moved();
    if random.next() < 0.6 {
        moved.speed = random.between(0.02, 1.0);
        asked.speed.iter_mut().for_each(|v| *v *= moved.speed);
    }
    if random.next() < 0.4 {
        let value = random.between(0.05, 1.0) * acceleration;
        moved.acceleration = Some(PerJoint::All(value));
        asked.gain.fill(value);
    }
    if random.next() < 0.6 {
        for i in 0..n {
            let (a, b) = (random.between(low[i], high[i]), random.between(low[i], high[i]));
            let gap = 0.3 - (a - b).abs();
            let wide = gap.max(0.0);
            (asked.lower[i], asked.upper[i]) =
                ((a.min(b) - wide).max(low[i]), (a.max(b) + wide).min(high[i]));
        }
        moved.lower = by_joint(model, |i| asked.lower[i]);
        moved.upper = by_joint(model, |i| asked.upper[i]);
    }
    (moved, asked)
}
