//! A limit of your own: two joints of a Panda together may not turn further than 1 rad.

use nearl_constraints::*;
use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let model = Model::from_urdf(Path::new("examples/robots/panda/panda.urdf"))?;
    let together = UserRow::new(UserRowSettings {
        name: "shoulder and elbow".into(),
        terms: [("q.panda_joint1".into(), 1.0), ("q.panda_joint3".into(), 1.0)].into(),
        lower: None,
        upper: Some(1.0),
        equals: None,
        braking: Some(2.0),
        margin: 0.0,
        soft: None,
    });
    let limits: Vec<Box<dyn Limit>> = vec![
        Box::new(PositionLimit::default()),
        Box::new(VelocityLimit::default()),
        Box::new(AccelerationLimit::uniform(10.0)),
        Box::new(together),
    ];
    let joints: Vec<usize> = (0..model.nv()).collect();
    let mut projector = Projector::new(&model, &limits, &joints, Settings::new(1e-3, 1))?;

    let (mut q, mut v) = (vec![0.0, 0.0, 0.0, -1.5, 0.0, 1.5, 0.0], vec![0.0; 7]);
    let away = [1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0];
    let (mut proposal, mut target) = (Proposal::new(&model), Target::new(&model));
    for _ in 0..3000 {
        // Three seconds of a robot that reaches every target.
        proposal.q.iter_mut().zip(&q).zip(away).for_each(|((to, q), away)| *to = q + away);
        proposal.v.copy_from_slice(&away);
        projector.project(&q, &v, &proposal, &mut target);
        q.copy_from_slice(&target.q);
        v.copy_from_slice(&target.v);
    }
    println!("joint 1 + joint 3 = {:.4} rad, allowed 1", q[0] + q[2]);
    assert!(q[0] + q[2] <= 1.0 + 1e-9);
    Ok(())
}
