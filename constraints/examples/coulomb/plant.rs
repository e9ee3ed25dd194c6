//! An arm with Coulomb friction, and an attack on it that measures by how much states, accelerations and motor forces exceed their limits.

use nearl_constraints::description::FrictionLaw;
use nearl_constraints::*;

#[path = "attack.rs"]
mod attack;
use attack::{FINE, Rubs, Seen, rub};

/// The plant: semi-implicit Euler steps of [`FINE`] with Coulomb friction.
struct Plant {
    dynamics: Dynamics,
    friction: Vec<f64>,
    q: Vec<f64>,
    v: Vec<f64>,
    /// Physics steps in a control period.
    steps: u32,
}

impl Rubs for Plant {
    fn state(&self) -> (Vec<f64>, Vec<f64>) {
        (self.q.clone(), self.v.clone())
    }

    fn go(&mut self, tau: &[f64]) {
        for _ in 0..self.steps {
            let [_, acceleration] = rub(&mut self.dynamics, (&self.q, &self.v), tau, &self.friction);
            for (i, a) in acceleration.iter().enumerate() {
                self.v[i] += FINE * a;
                self.q[i] += FINE * self.v[i];
            }
        }
    }
}

/// Attacks an arm that rubs by Coulomb's law; projector and inverse dynamics take its friction for `law`, or for none.
pub fn attacked(arm: &Model, law: Option<FrictionLaw>, period: (f64, u32), ticks: usize) -> Seen {
    let mut known = arm.description().clone();
    for joint in known.bodies.iter_mut().flat_map(|body| &mut body.joints) {
        match law {
            Some(law) => joint.friction_law = law,
            None => joint.friction = 0.0,
        }
    }
    let model = Model::from_description(known).unwrap();
    let (low, high) = (arm.lower_position_limit(), arm.upper_position_limit());
    let mut plant = Plant {
        dynamics: Dynamics::new(arm),
        friction: arm.friction().to_vec(),
        q: low.iter().zip(high).map(|(l, h)| 0.5 * (l + h)).collect(),
        v: vec![0.0; arm.nv()],
        steps: (period.0 / FINE).round() as u32,
    };
    attack::attacked(&mut plant, &model, period, ticks)
}
