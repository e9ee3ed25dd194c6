//! Proposals that try to break a limit.

use crate::random::Random;
use nearl_runtime::constraints::{Dynamics, LimitSet, Model, Proposal};

/// Kinds of attack.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    /// A random two-layer network of state to proposal, a new one every 5000 ticks.
    Network,
    /// Three times the speed limit one way or the other, joint by joint.
    BangBang,
    /// Along the gradient of one limit's use: a position, a speed, a motor force; or of whichever is used most.
    Gradient,
    /// Bang-bang in which NaN, infinities and numbers up to 1e300 arrive for 1 to 20 ticks.
    Bursts,
}

impl Kind {
    pub(crate) const ALL: [Kind; 4] = [Kind::Network, Kind::BangBang, Kind::Gradient, Kind::Bursts];

    pub(crate) fn name(self) -> &'static str {
        match self {
            Kind::Network => "network",
            Kind::BangBang => "bang-bang",
            Kind::Gradient => "gradient",
            Kind::Bursts => "bursts",
        }
    }
}

const HIDDEN: usize = 32;

/// An attack on a robot whose joints have one dof each (nq = nv).
pub(crate) struct Attack<'a> {
    kind: Kind,
    limits: &'a LimitSet,
    dt: f64,
    n: usize,
    random: Random,
    dynamics: Dynamics,
    weights: Vec<f64>,
    side: Vec<f64>,
    objective: usize,
    joint: usize,
    sign: f64,
    burst: usize,
    mass: Vec<f64>,
    nle: Vec<f64>,
}

impl<'a> Attack<'a> {
    pub(crate) fn new(kind: Kind, model: &Model, limits: &'a LimitSet, dt: f64, seed: u64) -> Attack<'a> {
        let n = model.nv();
        Attack {
            kind,
            limits,
            dt,
            n,
            random: Random(seed),
            dynamics: Dynamics::new(model),
            weights: vec![0.0; HIDDEN * (2 * n + 1) + 2 * n * HIDDEN],
            side: vec![1.0; n],
            objective: 0,
            joint: 0,
            sign: 1.0,
            burst: 0,
            mass: vec![0.0; n * n],
            nle: vec![0.0; n],
        }
    }

    pub(crate) fn propose(&mut self, tick: usize, q: &[f64], v: &[f64], out: &mut Proposal) {
        match self.kind {
            Kind::Network => self.network(tick, q, v, out),
            Kind::BangBang => self.bang_bang(tick, q, out),
            Kind::Gradient => self.gradient(tick, q, v, out),
            Kind::Bursts => self.bursts(tick, q, out),
        }
    }

    fn network(&mut self, tick: usize, q: &[f64], v: &[f64], out: &mut Proposal) {
        let n = self.n;
        if tick.is_multiple_of(5000) {
            let gain = self.random.between(0.5, 4.0);
            for w in &mut self.weights {
                *w = gain * self.random.between(-1.0, 1.0);
            }
        }
        let input = |j: usize| match j {
            j if j < n => 2.0 * (q[j] - self.middle(j)) / self.width(j),
            j if j < 2 * n => v[j - n] / self.limits.velocity[j - n],
            _ => 1.0,
        };
        let (first, second) = self.weights.split_at(HIDDEN * (2 * n + 1));
        let mut hidden = [0.0; HIDDEN];
        for (h, row) in hidden.iter_mut().zip(first.chunks_exact(2 * n + 1)) {
            *h = row.iter().enumerate().map(|(j, w)| w * input(j)).sum::<f64>().tanh();
        }
        for (k, row) in second.chunks_exact(HIDDEN).enumerate() {
            let y = row.iter().zip(&hidden).map(|(w, h)| w * h).sum::<f64>().tanh();
            let i = k % n;
            let speed = 2.0 * self.limits.velocity[i] * y;
            if k < n { out.q[i] = q[i] + self.dt * speed } else { out.v[i] = speed }
        }
    }

    fn bang_bang(&mut self, tick: usize, q: &[f64], out: &mut Proposal) {
        for i in 0..self.n {
            if tick.is_multiple_of(700) || self.random.next() < 1.0 / 300.0 {
                self.side[i] = if self.random.next() < 0.5 { -1.0 } else { 1.0 };
            }
            let speed = 3.0 * self.side[i] * self.limits.velocity[i];
            (out.q[i], out.v[i]) = (q[i] + self.dt * speed, speed);
        }
    }

    fn gradient(&mut self, tick: usize, q: &[f64], v: &[f64], out: &mut Proposal) {
        if tick.is_multiple_of(400) {
            self.objective = below(&mut self.random, 4);
            self.joint = below(&mut self.random, self.n);
            self.sign = if self.random.next() < 0.5 { -1.0 } else { 1.0 };
        }
        self.dynamics.mass(q, &mut self.mass);
        self.dynamics.nle(q, v, &mut self.nle);
        let limits = self.limits;
        let place = |i: usize| 2.0 * (q[i] - self.middle(i)) / self.width(i);
        let (speed, force) =
            (|i: usize| v[i] / limits.velocity[i], |i: usize| self.nle[i] / limits.effort[i]);
        let most = |f: &dyn Fn(usize) -> f64| {
            (0..self.n).fold((0, 0.0f64), |m, i| if f(i).abs() > m.1.abs() { (i, f(i)) } else { m })
        };
        let (p, s, t) = (most(&place), most(&speed), most(&force));
        let (objective, joint, sign) = match self.objective {
            3 if t.1.abs() > p.1.abs().max(s.1.abs()) => (2, t.0, t.1.signum()),
            3 => (4, if p.1.abs() > s.1.abs() { p.0 } else { s.0 }, p.1.signum()),
            k => (k, self.joint, self.sign),
        };
        let row = &self.mass[joint * self.n..(joint + 1) * self.n];
        let largest = row.iter().fold(f64::MIN_POSITIVE, |m, x| m.max(x.abs()));
        for i in 0..self.n {
            let slope = match objective {
                0 => place(i).signum(),
                1 => speed(i).signum(),
                2 => sign * row[i] / largest,
                _ => f64::from(u8::from(i == joint)) * sign,
            };
            out.v[i] = v[i] + 10.0 * self.dt * limits.acceleration[i] * slope;
            out.q[i] = q[i] + self.dt * out.v[i];
        }
    }

    fn bursts(&mut self, tick: usize, q: &[f64], out: &mut Proposal) {
        const BAD: [f64; 7] =
            [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e300, -1e300, 1e12, f64::MIN_POSITIVE];
        self.bang_bang(tick, q, out);
        if self.burst == 0 && self.random.next() < 1.0 / 40.0 {
            self.burst = 1 + below(&mut self.random, 20);
        }
        if self.burst == 0 {
            return;
        }
        self.burst -= 1;
        let finite = self.random.next() < 0.5;
        for k in 0..2 * self.n {
            if self.random.next() < 0.3 {
                let bad = BAD[if finite {
                    3 + below(&mut self.random, 4)
                } else {
                    below(&mut self.random, BAD.len())
                }];
                if k < self.n { out.q[k] = bad } else { out.v[k - self.n] = bad }
            }
        }
    }

    fn middle(&self, i: usize) -> f64 {
        0.5 * (self.limits.q_lower[i] + self.limits.q_upper[i])
    }

    fn width(&self, i: usize) -> f64 {
        self.limits.q_upper[i] - self.limits.q_lower[i]
    }
}

/// A whole number below `n`.
fn below(random: &mut Random, n: usize) -> usize {
    (random.next() * n as f64) as usize
}
