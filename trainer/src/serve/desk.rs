//! Takes requests in, decides whose chunk is simulated next, and sends what is ready.

use super::job::{Job, Stage};
use super::pool::{Outcome, Pool};
use super::refusal::Refusal;
use super::turns::Turns;
use super::{Report, ServeError, Settings};
use crate::rollout::Worker;
use nearl_runtime::Snapshot;
use nearl_runtime::rollout_protocol::{
    Answer, Caller, Constraints, Layout, MAX_CHUNK, ReplyMessage, Request, constraint_set, decode,
};
use std::collections::{BTreeMap, HashSet};

pub(super) struct Desk {
    jobs: BTreeMap<u64, Job>,
    /// Answers that end a request at once, and wait for room.
    refusals: Vec<Refusal>,
    turns: Turns<u64>,
    slots: u64,
    settings: Settings,
    layout: Layout,
    /// Steps of a full chunk.
    rows: usize,
    version: u64,
    constraints: u64,
    /// Workers of requests that ended.
    freed: Vec<Box<Worker>>,
    report: Report,
}

impl Desk {
    pub(super) fn new(snapshot: &Snapshot, settings: &Settings, layout: Layout) -> Result<Desk, ServeError> {
        let (manifest, width) = (&snapshot.manifest, layout.width());
        if width > MAX_CHUNK {
            return Err(ServeError::Wide { task: manifest.task.name.clone(), width });
        }
        Ok(Desk {
            jobs: BTreeMap::new(),
            refusals: Vec::new(),
            turns: Turns::new(),
            slots: 0,
            settings: settings.clone(),
            layout,
            rows: MAX_CHUNK / width,
            version: manifest.version,
            constraints: constraint_set(manifest),
            freed: Vec::new(),
            report: Report::default(),
        })
    }

    /// Accepts or refuses a request; every one that can be answered is.
    pub(super) fn admit(&mut self, caller: Caller) {
        self.report.requests += 1;
        let (number, verdict) = match decode(caller.bytes()) {
            Ok((number, _, request)) => (number, self.check(request)),
            Err(e) => (e.request, Err((Answer::BadRequest, e.reason))),
        };
        match verdict {
            Ok(request) => self.accept(caller, number, request),
            Err((answer, text)) => {
                match answer {
                    Answer::Busy => self.report.busy += 1,
                    Answer::LimitExceeded => self.report.limit += 1,
                    _ => self.report.malformed += 1,
                }
                self.refusals.push(Refusal::new(caller, number, answer, text));
            }
        }
    }

    fn check(&self, request: Request) -> Result<Request, (Answer, String)> {
        let (steps, most) = (request.n_steps, self.settings.max_steps);
        if steps > most {
            return Err((
                Answer::LimitExceeded,
                format!("{steps} steps are more than the {most} this server gives at once: ask for fewer"),
            ));
        }
        if let Some(version) = request.version.filter(|v| *v != self.version) {
            let own = self.version;
            return Err((
                Answer::BadRequest,
                format!(
                    "the server has version {own} of the policy, not {version}: ask for that or for the current one"
                ),
            ));
        }
        if let Constraints::Id(id) = request.constraints
            && id != self.constraints
        {
            let own = self.constraints;
            return Err((
                Answer::BadRequest,
                format!(
                    "the server has constraint set {own:016x}, not {id:016x}: start one with the other snapshot"
                ),
            ));
        }
        let places = self.settings.requests;
        if self.jobs.len() >= places {
            return Err((Answer::Busy, format!("all {places} places are taken: ask again later")));
        }
        Ok(request)
    }

    fn accept(&mut self, caller: Caller, number: u64, request: Request) {
        let reply = ReplyMessage {
            request: number,
            version: self.version,
            constraints: self.constraints,
            n_steps: request.n_steps,
            n_obs: self.layout.n_obs as u32,
            n_state: self.layout.n_state as u32,
            n_act: self.layout.n_act as u32,
            ..ReplyMessage::default()
        };
        self.slots += 1;
        self.jobs.insert(self.slots, Job::new(caller, request, reply));
    }

    /// Lets go of the requests of all other clients.
    pub(super) fn keep_only(&mut self, alive: &HashSet<u128>) {
        let dead: Vec<u64> =
            self.jobs.iter().filter(|(_, j)| !alive.contains(&j.client)).map(|(s, _)| *s).collect();
        for slot in dead {
            self.report.gone += 1;
            self.remove(slot);
        }
    }

    /// Sends what is ready, queues whose buffer is empty again, and lets go of what is cancelled, finished or without a
    /// client.
    pub(super) fn attend(&mut self) {
        self.refusals.retain_mut(|refusal| !refusal.is_over(self.settings.patience));
        let slots: Vec<u64> = self.jobs.keys().copied().collect();
        for slot in slots {
            let Some(job) = self.jobs.get_mut(&slot) else { continue };
            if job.caller.wants_cancel() && !matches!(job.stage, Stage::Ending(_)) {
                job.stop(Answer::Cancelled, "cancelled by the client");
            }
            let waits_too_long = job.stuck().is_some_and(|since| since.elapsed() > self.settings.patience);
            if !job.caller.is_connected() || waits_too_long || !job.flush() {
                self.report.gone += 1;
                self.remove(slot);
            } else if let (Stage::Ending(answer), true) = (job.stage, job.is_flushed()) {
                match answer {
                    Answer::Done => self.report.done += 1,
                    Answer::Cancelled => self.report.cancelled += 1,
                    _ => self.report.failed += 1,
                }
                self.remove(slot);
            } else if job.wants_turn() {
                self.turns.push(job.client, slot);
            }
        }
    }

    /// Gives the threads as many chunks as they want, one client after the other.
    pub(super) fn hand_out(&mut self, pool: &mut Pool) {
        for worker in self.freed.drain(..) {
            pool.keep(worker);
        }
        while pool.wants_more() {
            let Some(slot) = self.turns.pop() else { return };
            let Some(job) = self.jobs.get_mut(&slot).filter(|j| j.stage == Stage::Waiting) else { continue };
            pool.give(job.task(slot, self.rows));
        }
    }

    /// Takes a simulated chunk; [`Desk::attend`] sends it and queues the request again.
    pub(super) fn take_back(&mut self, outcome: Outcome) {
        let Outcome { slot, rows, result } = outcome;
        let Some(job) = self.jobs.get_mut(&slot).filter(|j| j.stage == Stage::AtWork) else {
            // Cancelled or gone in the meantime.
            self.freed.extend(result.ok().map(|(worker, _)| worker));
            return;
        };
        match result {
            Err(reason) => job.end(Answer::Failed, &reason),
            Ok((worker, numbers)) => {
                job.worker = Some(worker);
                self.report.steps += rows as u64;
                job.chunk(rows, numbers, self.layout);
            }
        }
    }

    /// Tells every client that the server ends.
    pub(super) fn close(mut self) -> Report {
        for job in self.jobs.values_mut() {
            self.report.closed += 1;
            job.stop(Answer::Closing, "the server was asked to end");
            job.flush();
        }
        self.report
    }

    fn remove(&mut self, slot: u64) {
        if let Some(job) = self.jobs.remove(&slot) {
            self.freed.extend(job.worker);
        }
    }
}
