//! What the forces of drives do within a period.

use std::cell::RefCell;
use std::rc::Rc;

use crate::motion::Machine;
use crate::period::Period;
use crate::rows::Passage;
use crate::steps::solve;

/// Products of numbers that take as long as moving a link.
const OF_A_LINK: usize = 50;

/// The joints that forces move, and the drives among what makes them.
#[derive(Debug)]
pub(crate) struct Drives {
    /// Stiffness and damping, by dof.
    gains: Vec<[f64; 2]>,
    /// Ascending; the others accelerate evenly, whatever it takes.
    free: Vec<usize>,
    found: RefCell<Option<Found>>,
    /// What was found last of a configuration.
    slopes: RefCell<Option<(Vec<f64>, Slopes)>>,
}

/// By dof of an acceleration, then by dof of a force at the start and at the end.
type Slopes = Rc<Vec<Vec<[f64; 2]>>>;

/// The last passage that was asked for.
#[derive(Debug)]
struct Found {
    q: Vec<f64>,
    v: Vec<f64>,
    a: Vec<f64>,
    ends: Vec<[f64; 2]>,
}

impl Drives {
    pub(crate) fn new(gains: &[Option<[f64; 2]>], free: Vec<usize>) -> Drives {
        let gains = gains.iter().map(|gains| gains.unwrap_or_default()).collect();
        Drives { gains, free, found: RefCell::default(), slopes: RefCell::default() }
    }

    /// Stiffness and damping of the drive of `dof`.
    pub(crate) fn gains(&self, dof: usize) -> [f64; 2] {
        self.gains[dof]
    }

    /// The force of each drive at the start and at the last evaluation of a period, less the mean force that the same acceleration takes if it is constant,
    /// by dof.
    pub(crate) fn ends(&self, m: &mut Machine, p: &Period, passage: &Passage<'_>) -> Vec<[f64; 2]> {
        let (q, v, a) = (passage.q, passage.v, passage.a);
        let known =
            self.found.borrow().as_ref().filter(|x| x.q == q && x.v == v && x.a == a).map(|x| x.ends.clone());
        known.unwrap_or_else(|| {
            let ends = self.reckon(m, p, (q, v, a));
            if !m.is_spent() {
                let (q, v, a) = (q.to_vec(), v.to_vec(), a.to_vec());
                self.found.replace(Some(Found { q, v, a, ends: ends.clone() }));
            }
            ends
        })
    }

    /// How [`Drives::ends`] change with each acceleration (nv x nv, a row for each acceleration).
    pub(crate) fn slopes(&self, m: &mut Machine, p: &Period, q: &[f64]) -> Slopes {
        let known = self.slopes.borrow().as_ref().filter(|(at, _)| at == q).map(|(_, slopes)| slopes.clone());
        known.unwrap_or_else(|| {
            let still = vec![0.0; self.gains.len()];
            let unit = |i: usize| (0..still.len()).map(|j| f64::from(u8::from(i == j))).collect::<Vec<_>>();
            let slopes: Slopes =
                Rc::new((0..still.len()).map(|i| self.reckon(m, p, (q, &still, &unit(i)))).collect());
            if !m.is_spent() {
                self.slopes.replace(Some((q.to_vec(), slopes.clone())));
            }
            slopes
        })
    }

    /// Linear in the velocities and accelerations.
    fn reckon(&self, m: &mut Machine, p: &Period, (q, v, a): (&[f64], &[f64], &[f64])) -> Vec<[f64; 2]> {
        let even = |i: usize| even(p, self.gains[i], v[i], a[i]);
        if p.sub_steps < 2 {
            return (0..v.len()).map(even).collect();
        }
        let (n, steps) = (self.free.len(), p.sub_steps as usize);
        m.spend(n * n * (n + steps * (n + 2)) / OF_A_LINK);
        if m.is_spent() {
            return (0..v.len()).map(even).collect(); // the tick is not verified
        }
        let inverse = self.inverse(m, p, q);
        // What is held moves each free joint from its velocity to the one that is asked for.
        let of = |i: usize| -> [f64; 4] {
            let [[stiffness, damping], [spring, damper]] = [self.gains[i], m.spring(i)];
            [stiffness, damping, spring, damper]
        };
        let gains: Vec<_> = self.free.iter().map(|i| of(*i)).collect();
        let walk = |held: &[f64], begun: &[f64]| -> Vec<[Vec<f64>; 2]> {
            let (mut way, mut speed) = (vec![0.0; n], begun.to_vec());
            let mut path = Vec::with_capacity(steps + 1);
            for _ in 0..steps {
                path.push([way.clone(), speed.clone()]);
                let push: Vec<f64> = (0..n)
                    .map(|r| {
                        let [k, d, spring, damper] = gains[r];
                        held[r] - (k + spring) * way[r] - (d + damper) * speed[r]
                    })
                    .collect();
                for r in 0..n {
                    speed[r] += p.tau * inverse[r].iter().zip(&push).map(|(x, y)| x * y).sum::<f64>();
                    way[r] += p.tau * speed[r];
                }
            }
            path.push([way, speed]);
            path
        };
        let begun: Vec<f64> = self.free.iter().map(|i| v[*i]).collect();
        let still = vec![0.0; n];
        let alone = walk(&still, &begun);
        let mut rows = vec![vec![0.0; n + 1]; n];
        for c in 0..n {
            let mut held = still.clone();
            held[c] = 1.0;
            let [_, speed] = &walk(&held, &still)[steps];
            (0..n).for_each(|r| rows[r][c] = speed[r]);
        }
        for (r, &i) in self.free.iter().enumerate() {
            rows[r][n] = v[i] + p.dt * a[i] - alone[steps][1][r];
        }
        let held = solve(rows);
        if held.iter().any(|x| !x.is_finite()) {
            return (0..v.len()).map(even).collect();
        }
        let path = walk(&held, &begun);
        let mut ends: Vec<[f64; 2]> = (0..v.len()).map(even).collect();
        for (r, &i) in self.free.iter().enumerate() {
            let [k, d, spring, damper] = gains[r];
            let at = |step: usize| [path[step][0][r], path[step][1][r]];
            let mean = [0, 1].map(|x| (0..steps).map(|step| at(step)[x]).sum::<f64>() / steps as f64);
            let (lag, sag) = (0.5 * (p.dt - p.tau), (p.dt * p.dt - p.tau * p.tau) / 6.0);
            // the joint's own spring and damper meet another way on average as well
            let own = spring * (mean[0] - lag * v[i] - sag * a[i]) + damper * (mean[1] - v[i] - lag * a[i]);
            ends[i] =
                [at(0), at(steps - 1)].map(|[way, speed]| own + k * (mean[0] - way) + d * (mean[1] - speed));
        }
        ends
    }

    /// Inverse of the mass matrix of the free dofs, with what a step takes implicitly of dampers.
    fn inverse(&self, m: &mut Machine, p: &Period, q: &[f64]) -> Vec<Vec<f64>> {
        let n = self.free.len();
        let (mut unit, mut column) = (vec![0.0; self.gains.len()], vec![0.0; self.gains.len()]);
        let mut mass = vec![vec![0.0; n + 1]; n];
        for (c, &j) in self.free.iter().enumerate() {
            unit.fill(0.0);
            unit[j] = 1.0;
            m.mass_times(q, &unit, &mut column);
            (0..n).for_each(|r| mass[r][c] = column[self.free[r]]);
            mass[c][c] += p.tau * m.damping(j);
        }
        let columns: Vec<Vec<f64>> = (0..n)
            .map(|c| {
                (0..n).for_each(|r| mass[r][n] = f64::from(u8::from(r == c)));
                solve(mass.clone())
            })
            .collect();
        (0..n).map(|r| (0..n).map(|c| columns[c][r]).collect()).collect()
    }
}

/// The same of a joint that accelerates evenly: the mean is that of `K (q* - q) - D v` over the evaluations.
fn even(p: &Period, [stiffness, damping]: [f64; 2], v: f64, a: f64) -> [f64; 2] {
    let (lag, sag, end) = (0.5 * (p.dt - p.tau), (p.dt * p.dt - p.tau * p.tau) / 6.0, p.dt - p.tau);
    let start = stiffness * (lag * v + sag * a) + damping * lag * a;
    [start, start - stiffness * end * (v + 0.5 * p.dt * a) - damping * end * a]
}
