//! Prior knowledge that is wrong: an arm carries a load of which its projector was not told. Prints what is promised, what happens, and what helps.

use nearl_constraints::description::Payload;
use nearl_constraints::*;
use std::path::Path;

const DT: f64 = 1e-3; // s
const TICKS: usize = 4000;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let empty = Model::from_urdf(Path::new("examples/robots/panda/panda.urdf"))?;
    for mass in [0.1, 0.5] {
        let load = Payload { frame: "panda_hand".into(), mass, com: [0.0; 3], inertia: [0.0; 6] };
        let loaded = empty.with_payload(&load)?;
        let cases =
            [("told", &loaded, 0.0), ("not told", &empty, 0.0), ("not told, with a margin", &empty, 0.05)];
        for (knows, believed, margin) in cases {
            let (targets, reached, worst) = outside(believed, &loaded, margin)?;
            println!(
                "{mass} kg, {knows}: {targets} targets and {reached} states too fast, by {worst:.3} rad/s"
            );
        }
    }
    Ok(())
}

/// Ticks whose target, and whose reached state, is faster than a joint may be, and by how much at most [rad/s].
fn outside(believed: &Model, arm: &Model, margin: f64) -> Result<(usize, usize, f64), LimitError> {
    let speed = VelocitySettings { margin: Some(PerJoint::All(margin)), ..VelocitySettings::default() };
    let limits: Vec<Box<dyn Limit>> = vec![
        Box::new(PositionLimit::default()),
        Box::new(VelocityLimit::new(speed)),
        Box::new(AccelerationLimit::uniform(15.0)),
    ];
    let mut projector = Projector::new(believed, &limits, &[0, 1, 2, 3, 4, 5, 6], Settings::new(DT, 1))?;
    let (mut inverse, mut truth) = (Dynamics::new(believed), Dynamics::new(arm));
    let (mut proposal, mut target) = (Proposal::new(believed), Target::new(believed));
    let (mut q, mut v, mut tau, mut a) = ([0.0, 0.0, 0.0, -1.5, 0.0, 1.5, 0.0], [0.0; 7], [0.0; 7], [0.0; 7]);
    let (mut targets, mut reached, mut worst) = (0, 0, 0.0_f64);
    let excess =
        |v: &[f64]| v.iter().zip(arm.velocity_limit()).map(|(v, most)| v.abs() - most).fold(0.0, f64::max);
    for tick in 0..TICKS {
        for i in 0..7 {
            let wish = 5.0 * (2.4 * ((1 + i) * (tick / 250)) as f64).sin(); // careless on purpose [rad/s]
            (proposal.q[i], proposal.v[i]) = (q[i] + DT * wish, wish);
        }
        projector.project(&q, &v, &proposal, &mut target);
        inverse.rnea(&q, &v, &target.acceleration, &mut tau); // what the believed arm would need [N·m]
        truth.aba(&q, &v, &tau, &mut a); // what the true one makes of it
        v.iter_mut().zip(a).for_each(|(v, a)| *v += DT * a);
        q.iter_mut().zip(v).for_each(|(q, v)| *q += DT * v);
        targets += usize::from(excess(&target.v) > 1e-9);
        reached += usize::from(excess(&v) > 1e-9);
        worst = worst.max(excess(&v));
    }
    Ok((targets, reached, worst))
}
