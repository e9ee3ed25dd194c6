//! Project one proposed state of a Panda, and say which limits held it back.

use nearl_constraints::*;
use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let model = Model::from_urdf(Path::new("examples/robots/panda/panda.urdf"))?;
    let limits: Vec<Box<dyn Limit>> = vec![
        Box::new(PositionLimit::default()),
        Box::new(VelocityLimit::default()),
        Box::new(AccelerationLimit::uniform(10.0)),
        Box::new(TorqueLimit::default()),
    ];
    let joints: Vec<usize> = (0..model.nv()).collect();
    let mut projector = Projector::new(&model, &limits, &joints, Settings::new(1e-3, 1))?;

    let (q, v) = ([0.0, 0.0, 0.0, -1.5, 0.0, 1.5, 0.0], [0.0; 7]); // [rad], [rad/s]
    let (mut proposal, mut target) = (Proposal::new(&model), Target::new(&model));
    proposal.q.copy_from_slice(&q.map(|q| q + 0.1));
    proposal.v.copy_from_slice(&v);
    let status = projector.project(&q, &v, &proposal, &mut target);
    println!("{status:?} moved by {:.3}", target.ledger.moved);
    for row in &target.ledger.active {
        println!("{}: {} ({:?}), multiplier {:.3}", row.row, row.kind.name(), row.side, row.multiplier);
    }
    Ok(())
}
