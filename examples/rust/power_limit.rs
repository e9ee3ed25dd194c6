//! A kind of limit of your own: the motors of an arm together give at most 30 W. docs/OWN_LIMIT.md explains it line by line.

use nearl_constraints::row::{Motion, Needs, RowsMut, TickStart};
use nearl_constraints::*;
use std::path::Path;

/// `v' tau <= P`: the mechanical power of all motors at the measured velocity \[W\].
#[derive(Debug)]
struct PowerLimit {
    watts: f64,
}

impl Limit for PowerLimit {
    fn name(&self) -> &'static str {
        "power"
    }

    fn rows(&self, _: &Model, _: &[usize]) -> Result<Option<Box<dyn Rows>>, LimitError> {
        Ok(Some(Box::new(PowerRow { watts: self.watts })))
    }
}

struct PowerRow {
    watts: f64,
}

impl Rows for PowerRow {
    fn kind(&self) -> Kind {
        Kind::User
    }

    fn names(&self) -> Vec<String> {
        vec!["power".into()]
    }

    fn sizes(&self) -> Vec<f64> {
        vec![self.watts]
    }

    fn needs(&self) -> Needs {
        Needs { motors: true, ..Needs::default() }
    }

    /// With the motor forces `tau = M y / T + b` of a velocity change `y`: `(v' M / T) y <= P - v' b`.
    fn fill(&mut self, tick: &mut TickStart<'_>, rows: &mut RowsMut<'_>) {
        let (nv, t) = (tick.v.len(), tick.period.dt);
        rows.upper[0] = self.watts;
        for i in 0..nv {
            rows.upper[0] -= tick.v[i] * tick.bias[i];
            for j in 0..nv {
                rows.row(0)[j] += tick.v[i] * tick.motors[i * nv + j] / t;
            }
        }
    }

    /// From the forces of inverse dynamics, which share nothing with the row.
    fn excess(&mut self, motion: &mut Motion<'_>, excess: &mut [f64]) {
        let power: f64 = motion.v.iter().zip(motion.torque).map(|(v, tau)| v * tau).sum();
        excess[0] = power / self.watts - 1.0;
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let model = Model::from_urdf(Path::new("examples/robots/panda/panda.urdf"))?;
    for watts in [1e6, 30.0] {
        let limits: Vec<Box<dyn Limit>> = vec![
            Box::new(PositionLimit::default()),
            Box::new(VelocityLimit::default()),
            Box::new(AccelerationLimit::uniform(10.0)),
            Box::new(PowerLimit { watts }),
        ];
        let mut projector = Projector::new(&model, &limits, &[0, 1, 2, 3, 4, 5, 6], Settings::new(1e-3, 1))?;
        let (mut dynamics, mut tau) = (Dynamics::new(&model), [0.0; 7]);
        let (mut q, mut v) = (vec![0.0, 0.0, 0.0, -1.5, 0.0, 1.5, 0.0], vec![0.0; 7]);
        let (mut proposal, mut target, mut most) = (Proposal::new(&model), Target::new(&model), 0.0_f64);
        for tick in 0..3000 {
            let wish = if tick / 500 % 2 == 0 { 3.0 } else { -3.0 }; // careless on purpose [rad/s]
            proposal.q.iter_mut().zip(&q).for_each(|(to, q)| *to = q + 1e-3 * wish);
            proposal.v.fill(wish);
            projector.project(&q, &v, &proposal, &mut target);
            dynamics.rnea(&q, &v, &target.acceleration, &mut tau);
            most = most.max(v.iter().zip(tau).map(|(v, tau)| v * tau).sum());
            q.copy_from_slice(&target.q);
            v.copy_from_slice(&target.v);
        }
        println!("allowed {watts} W, most {most:.2} W");
    }
    Ok(())
}
