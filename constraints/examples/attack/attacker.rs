//! Proposals that ask, tick by tick, for the state that would exceed a limit most.

use super::Random;
use super::meter::{Gauge, Meter, Passage};
use nearl_constraints::*;

#[derive(Clone, Copy)]
enum Way {
    /// Another wish each tick.
    Random,
    /// Three times the largest speed to and fro, joint by joint.
    BangBang,
    /// Three times the largest speed towards the limit that is nearest.
    Nearest,
    /// The same, a hundredth of the largest speed: it rests at the limit.
    Edge,
    /// A million times the largest speed.
    Far,
    /// One number of the proposal is none.
    NotANumber,
}

const WAYS: [Way; 7] =
    [Way::Random, Way::BangBang, Way::BangBang, Way::Nearest, Way::Nearest, Way::Edge, Way::Far];

/// One attacker in a closed loop; its way of attack changes every 0.4 s or so, for a few ticks it is no number.
pub struct Attacker {
    random: Random,
    way: Way,
    side: Vec<f64>,
    probe: (Vec<f64>, Vec<f64>),
    ticks: usize,
}

impl Attacker {
    pub fn new(seed: u64, nv: usize) -> Attacker {
        let probe = (vec![0.0; nv], vec![0.0; nv]);
        Attacker { random: Random(seed), way: Way::BangBang, side: vec![1.0; nv], probe, ticks: 0 }
    }

    /// Writes the proposal for the state; true when it holds numbers only.
    pub fn propose(
        &mut self,
        gauge: &mut Gauge,
        meters: &[Meter],
        (q, v): (&[f64], &[f64]),
        out: &mut Proposal,
    ) -> bool {
        let dt = gauge.period.dt;
        if self.random.next() < dt / 0.4 {
            self.way = WAYS[(self.random.next() * WAYS.len() as f64) as usize];
        }
        self.ticks += 1;
        let way = if self.random.next() < 0.01 { Way::NotANumber } else { self.way };
        let share = match way {
            Way::Edge => 0.01,
            Way::Far => 1e6,
            _ => 3.0,
        };
        match way {
            Way::Nearest | Way::Edge if self.ticks.is_multiple_of(8) => self.towards(gauge, meters, (q, v)),
            Way::Nearest | Way::Edge => {}
            Way::Random => self.side.iter_mut().for_each(|s| *s = self.random.between(-1.0, 1.0)),
            _ => {
                for side in &mut self.side {
                    if self.random.next() < dt / 0.3 {
                        *side = if self.random.next() < 0.5 { -1.0 } else { 1.0 };
                    }
                }
            }
        }
        for i in 0..v.len() {
            out.v[i] = share * self.side[i] * gauge.model.velocity_limit()[i];
            out.q[i] = q[i] + dt * out.v[i];
        }
        if matches!(way, Way::NotANumber) {
            let i = (self.random.next() * v.len() as f64) as usize;
            out.v[i] = f64::NAN;
            return false;
        }
        true
    }

    /// Each joint moves to where the nearest limit is nearer still, by finite differences of what is measured.
    fn towards(&mut self, gauge: &mut Gauge, meters: &[Meter], (q, v): (&[f64], &[f64])) {
        let h = 20.0 * gauge.period.dt;
        for i in 0..v.len() {
            let mut at = [0.0; 2];
            for (at, sign) in at.iter_mut().zip([-1.0, 1.0]) {
                let (q_next, v_next) = (&mut self.probe.0, &mut self.probe.1);
                v_next.copy_from_slice(v);
                v_next[i] += sign * 0.05 * gauge.model.velocity_limit()[i];
                (0..v.len()).for_each(|j| q_next[j] = q[j] + h * v_next[j]);
                *at = gauge.worst(&meters[1..], Passage { q, v, q_next, v_next });
            }
            if at[0] != at[1] && at.iter().all(|x| x.is_finite()) {
                self.side[i] = if at[1] > at[0] { 1.0 } else { -1.0 };
            } else if self.random.next() < 0.05 {
                self.side[i] = -self.side[i];
            }
        }
    }
}
