//! What the ticks before one left: where it goes on from, and what was asked of the robot for what it did up to it.

use crate::promise::{Promise, SetPoints};
use crate::tick::{State, Tick};

/// An acceleration [rad/s² or m/s²] and motor forces [N m or N], of each dof.
pub(crate) type Told = (Vec<f64>, Vec<f64>);

/// What the tick before left.
pub(crate) struct Past {
    /// Number of its state: the plant's start and the count since.
    pub(crate) epoch: u64,
    pub(crate) seq: u64,
    pub(crate) episode: u64,
    /// What it was measured to be, and the robot's clock then [s].
    pub(crate) measured: (Vec<f64>, Vec<f64>),
    pub(crate) time: f64,
    pub(crate) target: (Vec<f64>, Vec<f64>),
    /// How often the plant had had no answer in time by then.
    pub(crate) late: u64,
    /// What was sent in its period, and in the one before it, of joints that follow by themselves what they are sent.
    pub(crate) sent: SetPoints,
    pub(crate) before: Option<SetPoints>,
    /// So many ticks of those two came after a gap of the log, from what was sent in ticks that it does not have.
    pub(crate) cut_off: u8,
    /// The brake that it stored; empty where it stored none.
    pub(crate) brake: Vec<f64>,
    /// What it asked of the robot, and what the tick before it did.
    pub(crate) asked: Asked,
    pub(crate) asked_before: Asked,
}

/// What a tick asked of the robot.
#[derive(Clone, Default)]
pub(crate) struct Asked {
    /// Acceleration, where it is known what it began from.
    pub(crate) a: Option<Vec<f64>>,
    /// Acceleration and motor forces, where they are what the next tick was told.
    pub(crate) told: Option<Told>,
}

/// What a tick goes on from (nq, nv), and the dofs whose set points wait for their joints.
pub(crate) struct Start {
    pub(crate) from: (Vec<f64>, Vec<f64>),
    /// What stood as sent, of joints that follow by themselves.
    pub(crate) sent: Option<SetPoints>,
    pub(crate) waiting: Vec<usize>,
}

/// What a log has of the ticks before one.
#[derive(Default)]
pub(crate) struct Before {
    pub(crate) past: Option<Past>,
    /// The log does not have the tick before.
    pub(crate) has_gap: bool,
    /// The loop had a clock of its own, and answered in every slot; else it answered a state when one came.
    pub(crate) keeps_time: bool,
}

/// Of the bits of a state: the plant braked by itself last.
const BRAKED: u32 = 8;

impl Past {
    /// States between it and `next` that did not come.
    fn lost(&self, next: &State) -> u64 {
        next.seq.saturating_sub(self.seq.saturating_add(1))
    }

    /// The plant braked by itself up to `next`, a state that came after it.
    fn is_braked_since(&self, next: &State) -> bool {
        next.bits & BRAKED != 0 && self.is_before(next)
    }

    /// `next` is another state than its own.
    pub(crate) fn is_before(&self, next: &State) -> bool {
        (next.epoch, next.seq) != (self.epoch, self.seq)
    }

    /// What it answered is not what the robot did up to `tick`: it came too late, or the driver asked once more in its period.
    fn is_recalled(&self, tick: &Tick) -> bool {
        let (next, (q, v)) = (&tick.state, &self.measured);
        let stands = next.time > 0.0 && next.time == self.time && next.q == *q && next.v == *v;
        // A loop that takes a state that stands for a frozen one does not act on it.
        let is_doubled = stands && tick.sensed == "measured" && self.is_before(next);
        is_doubled || self.alone(next) > self.lost(next)
    }

    /// Periods up to `next` in which the plant had no answer in time.
    fn alone(&self, next: &State) -> u64 {
        next.late.saturating_sub(self.late)
    }
}

impl Before {
    /// What a tick goes on from: as measured or predicted, and of joints that follow by themselves what they were sent.
    ///
    /// # Errors
    /// Why the log does not say: what it was predicted from or what was sent is not in it, or its state is another robot's.
    pub(crate) fn start(&self, own: &Promise, tick: &Tick) -> Result<Start, &'static str> {
        if self.is_cut_off(own, tick) {
            return Err("they go on from what was sent in a tick that the log does not have");
        }
        let no = "they acted on a state predicted from a tick that the log does not have";
        let (mut q, mut v) = match (&tick.sensed[..], &self.past) {
            ("predicted", past) => past.as_ref().ok_or(no)?.target.clone(),
            _ => (tick.state.q.clone(), tick.state.v.clone()),
        };
        if [q.len(), v.len()] != [own.machine.nq(), own.machine.nv()] {
            return Err(no);
        }
        let (state, mut waiting, mut sent) = (&tick.state, Vec::new(), None);
        if let Some(past) = self.past.as_ref().filter(|past| own.follows() && past.epoch == state.epoch)
            && [past.target.0.len(), past.target.1.len()] == [q.len(), v.len()]
        {
            sent = self.standing(own, past, tick);
            waiting = sent.as_ref().map_or(Vec::new(), |sent| own.depart(sent, &mut q, &mut v));
        }
        Ok(Start { from: (q, v), sent, waiting })
    }

    /// The tick goes on from what was sent in one that the log does not have.
    pub(crate) fn is_cut_off(&self, own: &Promise, tick: &Tick) -> bool {
        let goes_back = |past: &Past| {
            let is_left = past.alone(&tick.state).max(past.lost(&tick.state)) > 0;
            past.cut_off > 0 && !self.keeps_time && (is_left || past.is_recalled(tick))
        };
        let is_back = self.past.as_ref().is_some_and(goes_back);
        is_back && own.goes_on() || self.has_gap && own.follows()
    }

    /// What was asked of the robot for what it does up to `tick`: by the tick before, or by the one before that where its answer came too late, and
    /// from there on what the driver made of it without an answer. Nothing is known where the plant braked by itself.
    pub(crate) fn asked(&self, own: &Promise, tick: &Tick) -> Asked {
        let state = &tick.state;
        let is_known = |past: &&Past| {
            let fits = [past.target.0.len(), past.target.1.len()] == [own.machine.nq(), own.machine.nv()];
            past.epoch == state.epoch && fits && !past.is_braked_since(state)
        };
        let Some(past) = self.past.as_ref().filter(is_known) else { return Asked::default() };
        let (lost, alone) = (past.lost(state), past.alone(state));
        let periods = lost.max(alone);
        let is_recalled = past.is_recalled(tick);
        if self.keeps_time || periods == 0 && !is_recalled {
            return past.asked.clone();
        }
        let (sent, mut asked) = match is_recalled {
            true => (past.before.as_ref(), past.asked_before.clone()),
            false => (Some(&past.sent), past.asked.clone()),
        };
        if own.follows() {
            let Some(sent) = sent else { return Asked::default() };
            let told = asked.told.as_mut().map(|(a, _)| a);
            asked.a.iter_mut().chain(told).for_each(|a| own.hold_asked(sent, periods, a));
        }
        asked
    }

    /// What stands as sent where `state` was measured: the last answer, or the one before it where that came too late, and from there on what the
    /// driver made of it without an answer. None where the plant braked by itself.
    fn standing(&self, own: &Promise, past: &Past, tick: &Tick) -> Option<SetPoints> {
        let state = &tick.state;
        if past.is_braked_since(state) {
            return None;
        }
        if self.keeps_time {
            return Some(past.sent.clone()); // it answered in every slot
        }
        let (lost, alone) = (past.lost(state), past.alone(state));
        let applied = if past.is_recalled(tick) { past.before.as_ref() } else { Some(&past.sent) };
        let mut sent = applied?.clone();
        own.hold(&mut sent, lost.max(alone));
        Some(sent)
    }

    /// Notes what `tick` asked for, for the next one: where it began, what had been asked before it, and what the next one is told of it.
    pub(crate) fn note(
        &mut self,
        own: &Promise,
        tick: &Tick,
        start: Option<Start>,
        (asked_before, told): (Asked, Option<Told>),
    ) {
        // Of joints that go on from what they were sent, or of a predicted state, not known after a gap.
        let cut_off = match self.is_cut_off(own, tick) {
            true => 2,
            false => self.past.as_ref().map_or(0, |past| past.cut_off.saturating_sub(1)),
        };
        let (begun, before) = start.map_or((None, None), |start| (Some(start.from), start.sent));
        let sent = own.sends(tick, begun.as_ref());
        let v = begun.as_ref().map_or(&tick.state.v, |(_, v)| v);
        let (nq, nv, dt) = (own.machine.nq(), own.machine.nv(), own.period.dt);
        (self.past, self.has_gap) = (None, false);
        if [tick.target_q.len(), tick.target_v.len(), v.len()] != [nq, nv, nv] {
            return; // it was named, and leaves nothing that the next tick could be confirmed by
        }
        let a = begun.map(|(_, v)| tick.target_v.iter().zip(&v).map(|(to, from)| (to - from) / dt).collect());
        let State { epoch, seq, episode, time, late, ref q, ref v, .. } = tick.state;
        self.past = Some(Past {
            epoch,
            seq,
            episode,
            measured: (q.clone(), v.clone()),
            time,
            target: (tick.target_q.clone(), tick.target_v.clone()),
            late,
            sent,
            before,
            cut_off,
            brake: tick.brake.clone(),
            asked: Asked { a, told },
            asked_before,
        });
    }
}
