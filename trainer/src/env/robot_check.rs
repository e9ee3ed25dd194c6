//! Whether a task file's robot is the one that a native environment simulates.

use nearl_runtime::constraints::{Dynamics, Model};

/// Numbers this close are the same, relative to the larger one.
const SAME: f64 = 1e-9;

/// The first thing in which two robots differ, in words; `None` where they are alike.
pub(super) fn difference(a: &Model, b: &Model) -> Option<String> {
    let names = |m: &Model| m.joints().iter().map(|j| j.name.clone()).collect::<Vec<_>>();
    if names(a) != names(b) {
        return Some(format!("its joints ({} instead of {})", names(a).join(", "), names(b).join(", ")));
    }
    let mass = |m: &Model| {
        let mut mass = vec![0.0; m.nv() * m.nv()];
        Dynamics::new(m).mass(&m.neutral(), &mut mass);
        mass
    };
    let facts = [
        ("position limits", a.lower_position_limit().to_vec(), b.lower_position_limit().to_vec()),
        ("position limits", a.upper_position_limit().to_vec(), b.upper_position_limit().to_vec()),
        ("velocity limits", a.velocity_limit().to_vec(), b.velocity_limit().to_vec()),
        ("effort limits", a.effort_limit().to_vec(), b.effort_limit().to_vec()),
        ("damping", a.damping().to_vec(), b.damping().to_vec()),
        ("damping of drives", a.drive_damping().to_vec(), b.drive_damping().to_vec()),
        ("masses or where they lie", mass(a), mass(b)),
        ("masses", vec![a.total_mass()], vec![b.total_mass()]),
    ];
    let same = |x: f64, y: f64| x == y || (x - y).abs() <= SAME * x.abs().max(y.abs());
    let alike = |x: &[f64], y: &[f64]| x.iter().zip(y).all(|(x, y)| same(*x, *y));
    facts.into_iter().find(|(_, x, y)| !alike(x, y)).map(|(what, ..)| format!("its {what}"))
}
