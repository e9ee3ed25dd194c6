//! How the driver stops the arm by itself, and keeps it where it stopped.

use crate::{DT, N};
use franka::{Model, RobotState};

/// Speed below which a joint counts as standing [rad/s].
const STANDING: f64 = 1e-2;
/// Stiffness [N m/rad] and damping [N m s/rad] about the reference: those of libfranka's example of joint impedance.
const STIFFNESS: [f64; N] = [600.0, 600.0, 600.0, 600.0, 250.0, 150.0, 50.0];
const DAMPING: [f64; N] = [50.0, 50.0, 50.0, 50.0, 30.0, 25.0, 15.0];

/// A motion to rest in which every joint slows down by `braking` [rad/s²], as the loop's position limits count on. It is followed by feedback:
/// the robot's own mass matrix has no rotors, and its joints rub.
pub(crate) struct Brake {
    braking: f64,
    /// Position and velocity of the motion to rest.
    reference: Option<([f64; N], [f64; N])>,
    stands: bool,
}

impl Brake {
    pub(crate) fn new(braking: f64) -> Brake {
        Brake { braking, reference: None, stands: false }
    }

    /// A loop leads again.
    pub(crate) fn release(&mut self) {
        (self.reference, self.stands) = (None, false);
    }

    /// Whether the arm was brought to rest.
    pub(crate) fn stands(&self) -> bool {
        self.stands
    }

    /// Torques without gravity [N m]: `M a + C v + K (q_ref - q) + D (v_ref - v)`.
    pub(crate) fn torque(&mut self, model: &Model, state: &RobotState) -> [f64; N] {
        let (q, v) = self.reference.get_or_insert((state.q, state.dq));
        let a: [f64; N] = std::array::from_fn(|i| (-v[i] / DT).clamp(-self.braking, self.braking));
        for i in 0..N {
            q[i] += DT * (v[i] + 0.5 * DT * a[i]);
            v[i] += DT * a[i];
        }
        self.stands = v.iter().chain(&state.dq).all(|v| v.abs() < STANDING);
        let (mass, coriolis) = (model.mass(state), model.coriolis(state));
        std::array::from_fn(|i| {
            let forward = coriolis[i] + (0..N).map(|j| mass[N * j + i] * a[j]).sum::<f64>();
            forward + STIFFNESS[i] * (q[i] - state.q[i]) + DAMPING[i] * (v[i] - state.dq[i])
        })
    }
}
