//! How well the gains of a joint's drive must be known for its limits to hold.
//!
//! A drive gives `K (u - q) - D v`. Its own damping is often a stronger brake than the acceleration limit allows, so the target `u` takes `D v` out
//! and puts the allowed force in. Where the real damping is `(1 - e) D`, a part `e D v` of what was taken out was never there, and it pushes:
//!
//! ```text
//! acceleration while braking at A  =  -A + e D v / I          I = 1 / (M^-1)_jj, rotor included
//! the joint still slows down at V  while  e < A I / (D V)
//! ```
//!
//! A stiffness of `(1 + e) K` does nearly the same. Beyond `e` a joint at its speed limit runs away from it, faster and faster.

use nearl_constraints::{Drive, Dynamics, LimitSet, Model};

use crate::holding::{ranges, spread};

/// Seeded configurations in which the smallest inertia is looked for.
const STARTS: usize = 500;

/// What a joint's drive may be off by.
#[derive(Clone, Debug, PartialEq)]
pub struct Tolerance {
    /// Joint.
    pub joint: String,
    /// Largest share by which damping may be less, or stiffness more, than stated.
    pub share: f64,
    /// D [N·m s/rad or N s/m].
    pub damping: f64,
    /// Speed limit V [rad/s or m/s].
    pub velocity: f64,
    /// Deceleration A that a brake counts on [rad/s² or m/s²].
    pub deceleration: f64,
    /// Smallest inertia found [kg m² or kg].
    pub inertia: f64,
}

/// The tolerance of each controllable joint that has a drive with damping, a speed limit and an acceleration limit. Joints that are not controllable
/// rest at the neutral configuration.
pub fn tolerances(
    model: &Model,
    limits: &LimitSet,
    controllable: &[usize],
    drives: &[Drive],
) -> Vec<Tolerance> {
    let mut found = Vec::new();
    for &dof in controllable {
        let Drive::Pd { damping, .. } = drives[dof] else { continue };
        let (velocity, deceleration) =
            (limits.velocity[dof], limits.braking[dof].min(limits.acceleration[dof]));
        if damping > 0.0 && velocity.is_finite() && deceleration.is_finite() {
            found.push((dof, damping, velocity, deceleration));
        }
    }
    if found.is_empty() {
        return Vec::new();
    }
    let ranges = ranges(model, limits, controllable);
    let (mut dynamics, rest) = (Dynamics::new(model), vec![0.0; model.nv()]);
    let (mut q, mut smallest) = (model.neutral(), vec![f64::INFINITY; model.nv()]);
    let (mut free, mut pushed, mut push) = (rest.clone(), rest.clone(), rest.clone());
    for start in 0..STARTS {
        spread(start, &ranges, &mut q);
        dynamics.aba(&q, &rest, &rest, &mut free);
        for &(dof, ..) in &found {
            push[dof] = 1.0;
            dynamics.aba(&q, &rest, &push, &mut pushed);
            push[dof] = 0.0;
            smallest[dof] = smallest[dof].min(1.0 / (pushed[dof] - free[dof]));
        }
    }
    let tolerance = |(dof, damping, velocity, deceleration): (usize, f64, f64, f64)| {
        let inertia = smallest[dof];
        let share = deceleration * inertia / (damping * velocity);
        Tolerance { joint: model.dof_name(dof), share, damping, velocity, deceleration, inertia }
    };
    found.into_iter().map(tolerance).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const PENDULUM: &str = r#"<robot name="pendulum"><link name="base"/>
        <link name="bob"><inertial><origin xyz="0 0 -0.5"/><mass value="2.0"/>
        <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
        <joint name="swing" type="revolute"><parent link="base"/><child link="bob"/><axis xyz="0 1 0"/>
        <limit lower="-1" upper="1" velocity="3" effort="100"/></joint></robot>"#;

    /// I = m l^2 + I_yy = 0.6 kg m², A I / (D V) = 5 * 0.6 / (4 * 3).
    #[test]
    fn tolerance_of_a_pendulum_by_hand() {
        let model = Model::from_urdf_text(PENDULUM).expect("robot");
        let mut limits = LimitSet::unlimited(1);
        (limits.velocity[0], limits.acceleration[0], limits.braking[0]) = (3.0, 8.0, 5.0);
        let drive = |damping| [Drive::Pd { stiffness: 100.0, damping }];
        let found = tolerances(&model, &limits, &[0], &drive(4.0));
        assert_eq!(found.len(), 1);
        assert!((found[0].inertia - 0.6).abs() < 1e-12 && (found[0].share - 0.25).abs() < 1e-12, "{found:?}");
        assert!(tolerances(&model, &limits, &[0], &drive(0.0)).is_empty());
        assert!(tolerances(&model, &limits, &[0], &[Drive::Effort]).is_empty());
        limits.velocity[0] = f64::INFINITY;
        assert!(tolerances(&model, &limits, &[0], &drive(4.0)).is_empty());
    }
}
