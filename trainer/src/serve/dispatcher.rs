//! Takes requests in, decides whose chunk is simulated next, and sends what is ready.

use super::job::{Job, Rollout, Stage, Subject};
use super::policy::{Policies, Validated, Validation, has_shape};
use super::pool::{Outcome, Pool};
use super::refusal::Refusal;
use super::training::{Load, Session};
use super::turns::Turns;
use super::{Report, ServeError, Settings};
use crate::rollout::Worker;
use nearl_rollout_protocol::{
    Answer, Caller, Constraints, Layout, MAX_CHUNK, ReplyMessage, Request, constraint_set, decode,
};
use nearl_runtime::Snapshot;
use nearl_runtime::link::Verdict;
use std::collections::{BTreeMap, HashMap, HashSet};
use std::sync::Arc;

pub(super) struct Dispatcher {
    jobs: BTreeMap<u64, Job>,
    /// Answers that end a request at once, and wait for room.
    refusals: Vec<Refusal>,
    turns: Turns<u64>,
    slots: u64,
    settings: Settings,
    layout: Layout,
    /// Steps of a full chunk.
    rows: usize,
    policies: Policies,
    constraints: u64,
    /// Environments of the clients that learn, between two of their requests.
    sessions: HashMap<u128, Session>,
    /// Workers of requests that ended.
    freed: Vec<Box<Worker>>,
    report: Report,
}

impl Dispatcher {
    pub(super) fn new(
        snapshot: &Snapshot,
        settings: &Settings,
        layout: Layout,
    ) -> Result<Dispatcher, ServeError> {
        let (manifest, width) = (&snapshot.manifest, layout.width());
        if width > MAX_CHUNK {
            return Err(ServeError::Wide { task: manifest.task.name.clone(), width });
        }
        Ok(Dispatcher {
            jobs: BTreeMap::new(),
            refusals: Vec::new(),
            turns: Turns::new(),
            slots: 0,
            settings: settings.clone(),
            layout,
            rows: MAX_CHUNK / width,
            policies: Policies::new(snapshot),
            constraints: constraint_set(manifest),
            sessions: HashMap::new(),
            freed: Vec::new(),
            report: Report::default(),
        })
    }

    /// Accepts or refuses a request; every one that can be answered is.
    pub(super) fn admit(&mut self, caller: Caller) {
        self.report.requests += 1;
        let (number, verdict) = match decode(caller.bytes()) {
            Ok((number, _, request)) => {
                let subject = self.check(&request).and_then(|policy| self.subject(&caller, &request, policy));
                (number, subject.map(|subject| (request, subject)))
            }
            Err(e) => (e.request, Err((Answer::BadRequest, e.reason))),
        };
        match verdict {
            Ok((request, subject)) => self.accept(caller, number, request, subject),
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

    /// The policy a request asks for, if it can be served.
    fn check(&self, request: &Request) -> Result<Arc<Snapshot>, (Answer, String)> {
        let (n_envs, settings) = (request.training.map_or(1, |t| t.n_envs), &self.settings);
        let (steps, most) = (request.n_steps.saturating_mul(n_envs), settings.max_steps);
        if steps > most {
            return Err((
                Answer::LimitExceeded,
                format!("{steps} steps are more than the {most} this server gives at once: ask for fewer"),
            ));
        }
        if n_envs > settings.max_envs {
            let most = settings.max_envs;
            return Err((
                Answer::LimitExceeded,
                format!(
                    "{n_envs} environments are more than the {most} this server keeps for a client: ask for fewer, or raise --max-envs"
                ),
            ));
        }
        let policy = self.policies.find(request).map_err(|text| (Answer::BadRequest, text))?;
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
        let places = settings.requests;
        if self.jobs.len() >= places {
            return Err((Answer::Busy, format!("all {places} places are taken: ask again later")));
        }
        Ok(policy)
    }

    /// What the request is about; a training goes on with what its client's last one left.
    fn subject(
        &mut self,
        caller: &Caller,
        request: &Request,
        policy: Arc<Snapshot>,
    ) -> Result<Subject, (Answer, String)> {
        let Some(training) = &request.training else { return Ok(Subject::Rollout(Rollout::default())) };
        let (client, n_envs) = (caller.client(), training.n_envs);
        self.has_room(client, Load { n_envs, steps: request.n_steps.saturating_mul(n_envs) })?;
        if training.begins {
            // What it began before is given up, and its memory with it.
            self.sessions.remove(&client);
            return Ok(Subject::Training(Session::begin(request, training, policy)));
        }
        let bad = |text: String| Err((Answer::BadRequest, text));
        let Some(session) = self.sessions.get(&client).filter(|s| s.n_envs() as u64 == n_envs) else {
            return bad(format!(
                "this client has no training of {n_envs} environments to go on with: begin one"
            ));
        };
        if !has_shape(session.snapshot(), &policy) {
            return bad("the policy has other networks than the training began with: begin one".into());
        }
        let Some(mut session) = self.sessions.remove(&client) else {
            return bad("it is gone: begin one".into());
        };
        session.go_on(request, policy);
        Ok(Subject::Training(session))
    }

    /// Refuses what would keep more than the server allows for all trainings together; what the client itself keeps between two requests
    /// is given up, or taken up again.
    fn has_room(&self, client: u128, wish: Load) -> Result<(), (Answer, String)> {
        let others = self.sessions.iter().filter(|(id, _)| **id != client).map(|(_, s)| s.load());
        let kept: Load = self.jobs.values().map(Job::load).chain(others).chain([wish]).sum();
        let Settings { max_envs, max_steps, .. } = self.settings;
        if kept.n_envs <= max_envs && kept.steps <= max_steps {
            return Ok(());
        }
        Err((
            Answer::Busy,
            format!(
                "with this, trainings would keep {} environments and {} steps, {max_envs} and {max_steps} at most: ask again later",
                kept.n_envs, kept.steps
            ),
        ))
    }

    fn accept(&mut self, caller: Caller, number: u64, request: Request, subject: Subject) {
        let reply = ReplyMessage {
            request: number,
            version: self.policies.version(&request),
            constraints: self.constraints,
            n_steps: request.n_steps,
            n_obs: self.layout.n_obs as u32,
            n_state: self.layout.n_state as u32,
            n_act: self.layout.n_act as u32,
            ..ReplyMessage::default()
        };
        self.slots += 1;
        self.jobs.insert(self.slots, Job::new(caller, request, subject, reply));
    }

    /// What a policy that is pushed to the server is held to.
    pub(super) fn validation(&self) -> Validation {
        self.policies.validation()
    }

    /// Takes a policy that was pushed to the server, for those who learn.
    pub(super) fn take_policy(&mut self, version: u64, found: Validated) -> (Verdict, String) {
        match found {
            Ok(snapshot) => {
                self.policies.take(snapshot, version);
                (Verdict::Accepted, "in use by those who learn".into())
            }
            Err(refusal) => refusal,
        }
    }

    /// Lets go of the requests of all other clients.
    pub(super) fn keep_only(&mut self, alive: &HashSet<u128>) {
        let dead: Vec<u64> =
            self.jobs.iter().filter(|(_, j)| !alive.contains(&j.client)).map(|(s, _)| *s).collect();
        for slot in dead {
            self.report.gone += 1;
            self.remove(slot, false);
        }
        self.sessions.retain(|client, _| alive.contains(client));
    }

    /// True while a client has not read what is ready for it, or learns and will ask again soon.
    pub(super) fn is_awaited(&self) -> bool {
        !self.sessions.is_empty() || self.jobs.values().any(|job| !job.is_flushed())
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
                self.remove(slot, false);
            } else if let (Stage::Ending(answer), true) = (job.stage, job.is_flushed()) {
                match answer {
                    Answer::Done => self.report.done += 1,
                    Answer::Cancelled => self.report.cancelled += 1,
                    _ => self.report.failed += 1,
                }
                self.remove(slot, answer == Answer::Done);
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
            let Some(job) = self.jobs.get_mut(&slot).filter(|j| j.stage == Stage::Running) else { continue };
            if let Some(task) = job.task(slot, self.rows) {
                pool.give(task);
            }
            if job.wants_turn() {
                self.turns.push(job.client, slot);
            }
        }
    }

    /// Takes a simulated chunk; [`Dispatcher::attend`] sends it and queues the request again.
    pub(super) fn take_back(&mut self, outcome: Outcome) {
        let Outcome { slot, place, rows, result } = outcome;
        let Some(job) = self.jobs.get_mut(&slot).filter(|j| j.stage == Stage::Running) else {
            // Cancelled or gone in the meantime.
            self.freed.extend(result.ok().filter(|_| place.is_none()).map(|(worker, _)| worker));
            return;
        };
        match result {
            Err(reason) => job.end(Answer::Failed, &reason),
            Ok((worker, numbers)) => {
                self.report.steps += rows as u64;
                job.take_back(place, worker, rows, numbers);
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

    /// Forgets a request; a training whose every number was sent may be gone on with.
    fn remove(&mut self, slot: u64, is_done: bool) {
        let Some(job) = self.jobs.remove(&slot) else { return };
        let client = job.client;
        match job.into_subject() {
            Subject::Rollout(rollout) => self.freed.extend(rollout.into_worker()),
            Subject::Training(session) if is_done => drop(self.sessions.insert(client, session)),
            Subject::Training(_) => {}
        }
    }
}
