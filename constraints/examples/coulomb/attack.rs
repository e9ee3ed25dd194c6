//! Attacks an arm whose joints rub. The plant computes its Coulomb friction in small physics steps.

use nearl_constraints::*;

/// Physics steps of a plant that rubs by Coulomb's law [s].
pub const FINE: f64 = 2e-5;

/// Rounds of projected Gauss-Seidel.
const ROUNDS: usize = 50;

/// Limits: acceleration [rad/s²] and speed [rad/s] of each joint.
const ACCELERATION: f64 = 10.0;
const SPEED: f64 = 3.0;

/// splitmix64 in [-1, 1).
pub fn uniform(seed: &mut u64) -> f64 {
    *seed = seed.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let mut z = *seed;
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ (z >> 31)) >> 10) as f64 / (1u64 << 53) as f64 - 1.0
}

/// A plant under attack.
pub trait Rubs {
    /// Configuration and velocity.
    fn state(&self) -> (Vec<f64>, Vec<f64>);
    /// A control period under the motor forces `tau`.
    fn go(&mut self, tau: &[f64]);
}

/// Friction of all joints in a physics step of [`FINE`] under the motor forces `tau`, and the acceleration with it. Each joint's friction is
/// what would stop it in the step, at most its own `most`, solved for all joints at once:
///
/// ```text
///     v' = v + h (M + h D)^-1 (tau - nle - D v - friction),   |friction| <= most
/// ```
pub fn rub(dynamics: &mut Dynamics, (q, v): (&[f64], &[f64]), tau: &[f64], most: &[f64]) -> [Vec<f64>; 2] {
    let nv = tau.len();
    let (mut rows, mut bias) = (vec![0.0; nv * nv], vec![0.0; nv]);
    dynamics.motor_rows(&Period::new(FINE, 1), q, v, &mut rows, &mut bias);
    let unit = |i: usize| (0..nv).map(|j| f64::from(u8::from(i == j))).collect();
    let mobility: Vec<Vec<f64>> = (0..nv).map(|i| solved(nv, &rows, unit(i))).collect();
    let free = solved(nv, &rows, tau.iter().zip(&bias).map(|(t, b)| t - b).collect());
    let mut force = vec![0.0; nv];
    let accelerate =
        |i: usize, force: &[f64]| free[i] - (0..nv).map(|j| mobility[j][i] * force[j]).sum::<f64>();
    for _ in 0..ROUNDS {
        for i in 0..nv {
            let more = (v[i] / FINE + accelerate(i, &force)) / mobility[i][i];
            force[i] = (force[i] + more).clamp(-most[i], most[i]);
        }
    }
    let acceleration = (0..nv).map(|i| accelerate(i, &force)).collect();
    [force, acceleration]
}

/// `matrix^-1 x` by Gaussian elimination of a positive matrix (n x n, row-major).
fn solved(n: usize, matrix: &[f64], mut x: Vec<f64>) -> Vec<f64> {
    let mut m = matrix.to_vec();
    for k in 0..n {
        for r in k + 1..n {
            let share = m[r * n + k] / m[k * n + k];
            (k..n).for_each(|c| m[r * n + c] -= share * m[k * n + c]);
            x[r] -= share * x[k];
        }
    }
    for k in (0..n).rev() {
        let known: f64 = (k + 1..n).map(|c| m[k * n + c] * x[c]).sum();
        x[k] = (x[k] - known) / m[k * n + k];
    }
    x
}

/// What an attack came to: ticks, those over, and the largest acceleration, speed, position and motor force beyond their limits.
#[derive(Debug)]
pub struct Seen {
    pub ticks: usize,
    pub over: usize,
    pub worst: [f64; 4],
}

/// Attacks `plant` with bang-bang proposals, a third of the time to stand; projector and inverse dynamics are of the robot `model`. A tick is
/// over where it leaves the acceleration limit by more than 1 % or another by more than 0.001.
pub fn attacked(plant: &mut dyn Rubs, model: &Model, (dt, sub_steps): (f64, u32), ticks: usize) -> Seen {
    let (nv, period) = (model.nv(), Period::new(dt, sub_steps));
    let limits: Vec<Box<dyn Limit>> = vec![
        Box::new(PositionLimit::default()),
        Box::new(VelocityLimit::values(PerJoint::All(SPEED))),
        Box::new(AccelerationLimit::uniform(ACCELERATION)),
        Box::new(TorqueLimit::default()),
    ];
    let dofs: Vec<usize> = (0..nv).collect();
    let mut projector = Projector::new(model, &limits, &dofs, Settings::new(dt, sub_steps)).unwrap();
    let (low, high) = (model.lower_position_limit(), model.upper_position_limit());
    let (mut dynamics, mut seed) = (Dynamics::new(model), 3);
    let (mut proposal, mut target) = (Proposal::new(model), Target::new(model));
    let mut seen = Seen { ticks, over: 0, worst: [f64::NEG_INFINITY; 4] };
    let (mut sign, mut tau) = (vec![1.0; nv], vec![0.0; nv]);
    let hold = (0.15 / dt).round() as usize;
    for tick in 0..ticks {
        let (q, v) = plant.state();
        for i in 0..nv {
            if (tick + 37 * i) % hold == 0 {
                sign[i] = uniform(&mut seed).signum();
            }
            // Standing, the sign of a velocity is noise.
            let wish = if tick % (3 * hold) < hold { 0.0 } else { sign[i] * 100.0 };
            (proposal.v[i], proposal.q[i]) = (wish, q[i] + dt * wish);
        }
        projector.project(&q, &v, &proposal, &mut target);
        dynamics.motors(&period, &q, &v, &target.acceleration, &mut tau);
        plant.go(&tau);
        let (q1, v1) = plant.state();
        let mut beyond = [f64::NEG_INFINITY; 4];
        for i in 0..nv {
            let at = [
                ((v1[i] - v[i]) / dt).abs() - ACCELERATION,
                v1[i].abs() - SPEED,
                (low[i] - q1[i]).max(q1[i] - high[i]),
                tau[i].abs() - model.effort_limit()[i],
            ];
            (0..4).for_each(|k| beyond[k] = f64::max(beyond[k], at[k]));
        }
        let is_over = beyond[0] > 0.01 * ACCELERATION || beyond[1..].iter().any(|x| *x > 1e-3);
        seen.over += usize::from(is_over);
        (0..4).for_each(|k| seen.worst[k] = seen.worst[k].max(beyond[k]));
    }
    seen
}
