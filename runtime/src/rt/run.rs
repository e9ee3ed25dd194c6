//! Putting the threads together: loop, I/O, builder and log, from the first state to the report.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

use rtrb::RingBuffer;

use crate::clock::{self, Bell};
use crate::controller::Parts;
use crate::holding;
use crate::link::torn;
use crate::link::{
    AskedMessage, LinkError, Message, RobotMessage, RobotName, RuntimeLink, StateMessage, TallyMessage,
    TickMessage,
};
use crate::log::{LogError, LogQueue, LogSummary};
use crate::percentiles::percentiles;
use crate::rt::build::Builder;
use crate::rt::core::{CoreSettings, Loaded, ProposerSettings};
use crate::rt::cycle::{Cycle, CycleEnd, CycleSettings, Ends, Sync};
use crate::rt::faults::FaultPlan;
use crate::rt::inbox::SnapshotInbox;
use crate::rt::io::{Health, Io, Traffic};
use crate::rt::meaning::Meaning;
use crate::rt::mode::ModeLimits;
use crate::rt::pilot::{Pilot, PilotBuilder};
use crate::rt::pinned::Pinned;
use crate::rt::receive::SnapshotReceiver;
use crate::rt::report::{PlantSummary, ProposerSummary, RunReport};
use crate::rt::residual::RollbackSettings;
use crate::rt::tick::{Build, LoopController, Refusal};
use crate::rt::watch::Watch;
use crate::rt::{Mode, Reason, swap};
use crate::snapshot::{Snapshot, SnapshotError, in_run};
use crate::stop::Stop;
use crate::thread::{CountAllocations, ThreadSettings, prepare};

/// Records between loop and I/O thread.
const RECORDS: usize = 256;

/// So much longer than its seconds of ticks may a run take when its plant keeps real time, but not in time [s].
const GRACE: f64 = 1.0;

/// Settings of a run.
#[derive(Clone, Debug)]
pub struct RunSettings {
    /// Who keeps time.
    pub sync: Sync,
    /// The loop's own rate \[Hz\]; it must be the plant's and makes the loop keep its own time ([`run`] only).
    pub rate: Option<f64>,
    /// Age at which a state is stale \[s\]; the default is 5 periods, at least 20 ms.
    pub age_limit: Option<f64>,
    /// So long before a state is due, the real-time thread wakes up to poll for it \[s\]; 0 sleeps until it comes.
    pub spin: f64,
    /// Seconds until the loop stops by itself, if `ticks` is not given: so many ticks, and of a plant that keeps real time no more than a
    /// second of the wall's beyond.
    pub seconds: Option<f64>,
    /// Ticks until the loop stops by itself.
    pub ticks: Option<u64>,
    /// How long to wait for the plant at start \[s\].
    pub patience: f64,
    /// So long without a state, and a plant that keeps real time is gone, or one in lockstep whose process has ended: the run ends \[s\].
    pub plant_patience: f64,
    /// So long without a new snapshot, and health and report say that nobody learns any more \[s\]; the loop goes on. None never says it.
    pub snapshot_age: Option<f64>,
    /// Largest speed entry that counts as standing still [rad/s or m/s].
    pub stop_speed: f64,
    /// Longest braking before the loop ends anyway \[s\].
    pub stop_patience: f64,
    /// A joint may move so many times further than its speed allows before its sample is implausible; 0 is no check.
    pub jump: f64,
    /// Time over which the first motion is let in, where a robot model knows the way to stand still \[s\].
    pub ramp: f64,
    /// When to brake and when to come back.
    pub modes: ModeLimits,
    /// Seed of the exploration noise; without one the policy acts without noise.
    pub explore: Option<u64>,
    /// Another process proposes in place of the policy.
    pub proposer: Option<ProposerSettings>,
    /// When a swapped-in snapshot is taken back.
    pub rollback: RollbackSettings,
    /// TOML file with a section `[constraints]`: the limits of the loop in place of its first snapshot's ([`run`] only).
    pub limits: Option<PathBuf>,
    /// Snapshots may bring looser limits: nothing is fixed ([`run`] only).
    pub allow_looser: bool,
    /// Faults to rehearse.
    pub faults: FaultPlan,
    /// Wishes for the real-time thread.
    pub thread: ThreadSettings,
    /// A wish that is refused is an error.
    pub strict: bool,
    /// Counts the heap allocations of the real-time thread, in a program whose allocator can.
    pub allocations: Option<CountAllocations>,
    /// What the wall clock is ahead of the monotonic one, for the times of day in the flight log \[ns\]; the loop itself never reads it.
    pub wall: u64,
    /// Flight log file.
    pub log: Option<PathBuf>,
    /// Facts written into the flight log (snapshot digest, command).
    pub metadata: BTreeMap<String, String>,
    /// Bytes of the first snapshot, kept in the flight log for replay.
    pub first: Vec<u8>,
    /// Told of each tick in which the mode becomes Fault, or Hold again, on a thread of its own, which may wait.
    pub on_mode: Option<OnMode>,
}

/// Tick, mode, and why.
pub type OnMode = fn(u64, Mode, Reason);

/// Modes that wait to be told.
const TOLD: usize = 16;

/// Tells the modes that are sent to it until nobody sends any more.
struct Teller {
    tell: SyncSender<(u64, Mode, Reason)>,
    thread: JoinHandle<()>,
}

impl Teller {
    fn start(on_mode: OnMode) -> Result<Teller, RunError> {
        let (tell, told) = sync_channel(TOLD);
        let thread = spawn("nearl-tell", move || {
            for (tick, mode, reason) in told {
                on_mode(tick, mode, reason);
            }
        })?;
        Ok(Teller { tell, thread })
    }
}

impl Default for RunSettings {
    fn default() -> Self {
        RunSettings {
            sync: Sync::Plant,
            rate: None,
            age_limit: None,
            spin: 50e-6,
            seconds: None,
            ticks: None,
            patience: 5.0,
            plant_patience: 5.0,
            snapshot_age: None,
            stop_speed: 1e-2,
            stop_patience: 1.0,
            jump: 3.0,
            ramp: 0.2,
            modes: ModeLimits::default(),
            explore: None,
            proposer: None,
            rollback: RollbackSettings::default(),
            limits: None,
            allow_looser: false,
            faults: FaultPlan::default(),
            thread: ThreadSettings::default(),
            strict: false,
            allocations: None,
            wall: 0,
            log: None,
            metadata: BTreeMap::new(),
            first: Vec::new(),
            on_mode: None,
        }
    }
}

/// Why a run could not start.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// The link.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// The flight log.
    #[error(transparent)]
    Log(#[from] LogError),
    /// The first snapshot does not fit the plant.
    #[error("{0}")]
    Snapshot(String),
    /// The asked rate is not the snapshot's.
    #[error(
        "--rate {rate} Hz, but snapshot and plant run at {own} Hz: leave --rate out to follow the plant, or give {own}"
    )]
    Rate {
        /// As asked \[Hz\].
        rate: f64,
        /// Of snapshot and plant \[Hz\].
        own: f64,
    },
    /// Somebody took the link's snapshots.
    #[error("the snapshots of `{0}` were taken from its link: open another RuntimeLink for the loop")]
    NoSnapshots(RobotName),
    /// Strict mode.
    #[error("--strict: {0}")]
    Strict(String),
    /// A setting that is no time or no number.
    #[error("{name} is {value}; give {wanted}")]
    Setting {
        /// Field of [`RunSettings`].
        name: &'static str,
        /// As given.
        value: f64,
        /// What is taken.
        wanted: &'static str,
    },
    /// A thread.
    #[error("thread `{name}` could not be started ({reason}): close other programs or raise `ulimit -u`")]
    Thread {
        /// Thread.
        name: &'static str,
        /// The system's reason.
        reason: String,
    },
    /// Another process was to propose, and the limits would not hold for what it says.
    #[error(
        "--proposer: this snapshot holds no limits for actions that come from elsewhere; write guard = true under [constraints] of its task, or take a \
         snapshot that proposes states"
    )]
    NoQuestion,
    /// Noise is the policy's.
    #[error(
        "--proposer and --explore exclude each other: another process proposes, and the policy that would explore does not run"
    )]
    Explores,
    /// A bug in the loop itself.
    #[error("thread `{0}` panicked: report it with the message above")]
    Panicked(&'static str),
}

impl RunSettings {
    /// Refuses times that are none: a ramp that is no number would let the first motion in at once.
    ///
    /// # Errors
    /// [`RunError::Setting`].
    pub fn check(&self) -> Result<(), RunError> {
        let fields = [
            ("ramp", self.ramp, "0 to 1e6 seconds"),
            ("patience", self.patience, "0 to 1e6 seconds"),
            ("jump", self.jump, "0 to 1e6 times the speed limit"),
        ];
        for (name, value, wanted) in fields {
            if !(0.0..=1e6).contains(&value) {
                return Err(RunError::Setting { name, value, wanted });
            }
        }
        match self.seconds {
            Some(value) if !(value > 0.0 && value <= 1e7) => Err(RunError::Setting {
                name: "seconds",
                value,
                wanted: "a time above 0, at most 1e7 seconds",
            }),
            _ => Ok(()),
        }
    }
}

/// Opens the link of `name` and waits for its plant.
pub fn connect(name: &RobotName, patience: f64) -> Result<(RuntimeLink, RobotMessage), LinkError> {
    let mut link = RuntimeLink::open(name)?;
    let robot = link.wait_for_plant(Duration::from_secs_f64(patience.max(0.0)))?;
    Ok((link, robot))
}

/// Runs the snapshot in `file` (or in the run folder `file`) on the plant named `plant` until `stop`: what `nearl run` does.
pub fn run(
    settings: &RunSettings,
    file: &Path,
    plant: &RobotName,
    stop: &Stop,
) -> Result<RunReport, RunError> {
    settings.check()?;
    let file = in_run(file);
    let refused = |text: String| RunError::Snapshot(format!("{}: {text}", file.display()));
    let snapshot = Snapshot::load(&file).map_err(|e| match e {
        SnapshotError::Unreadable { .. } => RunError::Snapshot(e.to_string()),
        other => refused(other.to_string()),
    })?;
    check_holding(&snapshot).map_err(refused)?;
    let pinned = pin(settings, &snapshot, &file)?;
    let (link, robot) = connect(plant, settings.patience)?;
    let first = Pilot::new(&snapshot, &robot).map_err(|e| refused(e.text))?;
    let mut settings = settings.clone();
    if let Some(rate) = settings.rate {
        if (rate * robot.dt - 1.0).abs() > 1e-6 {
            let own = 1.0 / robot.dt;
            return Err(RunError::Rate { rate, own });
        }
        settings.sync = Sync::Clock;
    }
    let facts = [
        ("digest", snapshot.digest()),
        ("task", snapshot.manifest.task.name.clone()),
        ("snapshot", file.display().to_string()),
        ("version", snapshot.manifest.version.to_string()),
        ("commands", serde_json::json!(first.commands(&snapshot.manifest)).to_string()),
    ];
    settings.first = snapshot.to_bytes();
    settings.metadata.extend(facts.map(|(key, value)| (key.to_owned(), value)));
    if let Some(pinned) = &pinned {
        settings.metadata.insert("limits".into(), pinned.to_json());
    }
    let meaning = Meaning::of(&snapshot.manifest).map_err(|e| refused(e.to_string()))?;
    let asked = settings.proposer.and(first.asks());
    let build = PilotBuilder { meaning: Some(meaning), pinned, asked };
    let mut report = run_loop(link, robot, first, build, &settings, stop)?;
    report.warnings.extend(snapshot.manifest.without_simulator().map(str::to_owned));
    if settings.proposer.is_none() {
        report.warnings.extend(snapshot.manifest.without_policy().map(str::to_owned));
    }
    Ok(report)
}

/// Refuses a robot whose motors cannot hold it within its limits: it would brake until it fell. Where the forces of drives are bounded and nothing is
/// promised of the motion (`guard = "drive"`), a robot on legs need not hold every pose.
pub(crate) fn check_holding(snapshot: &Snapshot) -> Result<(), String> {
    if snapshot.manifest.bounds_drives() {
        return Ok(());
    }
    let parts = Parts::new(&snapshot.manifest).map_err(|e| e.to_string())?;
    let period = snapshot.manifest.task.period();
    let limits =
        holding::standing(parts.projector.limits(), &snapshot.manifest.task.constraints, &parts.model);
    holding::refusal(&parts.model, &limits, parts.layout.controllable(), &period).map_or(Ok(()), Err)
}

/// The limits of the loop: those of `--limits`, which the first snapshot must keep too, else those of the first snapshot.
fn pin(settings: &RunSettings, first: &Snapshot, file: &Path) -> Result<Option<Pinned>, RunError> {
    let refused = |e: SnapshotError| RunError::Snapshot(e.to_string());
    match (&settings.limits, settings.allow_looser) {
        (_, true) => Ok(None),
        (None, false) => Pinned::of(&first.manifest, &format!("its first snapshot, {}", file.display()))
            .map(Some)
            .map_err(refused),
        (Some(limits), false) => {
            let pinned = Pinned::read(limits, &first.manifest).map_err(refused)?;
            let looser = |e: Refusal| RunError::Snapshot(format!("{}: {}", file.display(), e.text));
            pinned.admit(&first.manifest).map_err(looser)?;
            Ok(Some(pinned))
        }
    }
}

/// Runs `first` on the plant behind `link` until `stop` (or the settings' ticks), taking in new snapshots through
/// `build`. Brakes to zero velocity before it returns.
pub fn run_loop<B: Build>(
    link: RuntimeLink,
    robot: RobotMessage,
    first: B::Controller,
    build: B,
    settings: &RunSettings,
    stop: &Stop,
) -> Result<RunReport, RunError> {
    settings.check()?;
    let begin = clock::now();
    let version = first.version();
    let name = link.name().to_string();
    let (cycle, mut io) = assemble(link, robot, first, build, settings, stop)?;
    let (tell, teller) = match settings.on_mode.map(Teller::start).transpose()? {
        Some(Teller { tell, thread }) => (Some(tell), Some(thread)),
        None => (None, None),
    };
    io.watch.tell = tell;
    let over = Arc::new(AtomicBool::new(false));
    let io_thread = spawn("nearl-io", {
        let over = Arc::clone(&over);
        move || io.run(&over)
    })?;
    let end = start_cycle(cycle, settings);
    over.store(true, Ordering::Release);
    let mut io = io_thread.join().map_err(|_| RunError::Panicked("nearl-io"))?;
    io.watch.tell = None;
    if let Some(teller) = teller {
        let _ = teller.join();
    }
    let (end, warnings) = end?;
    Ok(report(name, &robot, settings.sync, begin, version, end, io, warnings))
}

/// Every ring and every thread's half of it.
fn assemble<B: Build>(
    mut link: RuntimeLink,
    robot: RobotMessage,
    first: B::Controller,
    build: B,
    settings: &RunSettings,
    stop: &Stop,
) -> Result<(Cycle<B::Controller>, Io<B>), RunError> {
    let Some(reader) = link.take_snapshots() else { return Err(RunError::NoSnapshots(link.name().clone())) };
    let asked = asked(&mut link, &robot, &first, settings)?;
    let cycle_settings = cycle_settings(&robot, settings);
    let told = first.told();
    let watch = Watch::of(first.watched());
    let log = open_log(&robot, (first.version(), &first.row_names()), &cycle_settings.core, settings)?;
    let thread_error = |name| move |e: std::io::Error| RunError::Thread { name, reason: e.to_string() };
    let builder = Builder::start(build).map_err(thread_error("nearl-build"))?;
    let receiver = SnapshotReceiver::start(reader).map_err(thread_error("nearl-receive"))?;
    let (states_in, states) = RingBuffer::new(8);
    let (proposals_in, proposals) = RingBuffer::new(4);
    let (actions, actions_out) = RingBuffer::new(8);
    let (records, records_out) = RingBuffer::new(RECORDS);
    let (swap, slot) = swap::slot();
    let (bell, gone) = (Arc::new(Bell::default()), Arc::new(AtomicBool::new(false)));
    let ends =
        Ends { states, proposals, actions, records, slot, bell: Arc::clone(&bell), gone: Arc::clone(&gone) };
    let health = Health::new(first.version()).map_err(|e| RunError::Snapshot(e.to_string()))?;
    let first = Box::new(Loaded { id: 0, controller: first });
    let cycle = Cycle::new(cycle_settings, first, settings.faults.clone(), ends, stop.clone());
    let mut snapshots =
        SnapshotInbox::new(receiver, builder, swap, settings.rollback, settings.first.clone());
    snapshots.set_rows(0, told);
    let mut tick = Box::new(TickMessage::zeroed());
    tick.period = clock::nanoseconds(robot.dt);
    let io = Io {
        link,
        period: clock::nanoseconds(robot.dt),
        polls_always: robot.is_lockstep() || settings.sync == Sync::Clock,
        priority: settings.thread.priority,
        robot,
        states: states_in,
        proposals: proposals_in,
        asked,
        actions: actions_out,
        records: records_out,
        bell,
        snapshots,
        log,
        explore: settings.explore,
        gone,
        gone_after: clock::nanoseconds(settings.plant_patience),
        snapshot_age: settings.snapshot_age.map(clock::nanoseconds),
        health,
        tick,
        traffic: Traffic::default(),
        tally: None,
        watch,
        foreign: None,
    };
    Ok((cycle, io))
}

/// Opens the topic on which another process is asked for proposals, if one is to make them.
fn asked<T: LoopController>(
    link: &mut RuntimeLink,
    robot: &RobotMessage,
    first: &T,
    settings: &RunSettings,
) -> Result<Option<Box<AskedMessage>>, RunError> {
    let Some(proposer) = settings.proposer else { return Ok(None) };
    if settings.explore.is_some() {
        return Err(RunError::Explores);
    }
    let question = first.question().ok_or(RunError::NoQuestion)?;
    let mut asked = Box::new(AskedMessage::zeroed());
    asked.set_entries(&question.names);
    (asked.kind, asked.policy_every) = (question.kind, question.policy_every as u64);
    (asked.dt, asked.age_limit, asked.hold) =
        (robot.dt, proposer.age_limit as f64 * 1e-9, proposer.hold as f64 * 1e-9);
    link.ask()?;
    Ok(Some(asked))
}

fn cycle_settings(robot: &RobotMessage, settings: &RunSettings) -> CycleSettings {
    // A lockstep plant may take its time between states (a reset, a reader that stops it).
    let shortest = if robot.is_lockstep() { 1.0 } else { 0.02 };
    let age_limit = settings.age_limit.unwrap_or_else(|| (5.0 * robot.dt).max(shortest));
    CycleSettings {
        core: CoreSettings {
            period: clock::nanoseconds(robot.dt),
            sync: settings.sync,
            age_limit: clock::nanoseconds(age_limit),
            real_time: !robot.is_lockstep(),
            stop_speed: settings.stop_speed,
            jump: settings.jump,
            ramp: (settings.ramp / robot.dt).round() as u32,
            modes: settings.modes,
            explore: settings.explore,
            proposer: settings.proposer,
        },
        spin: if robot.is_lockstep() { 0 } else { clock::nanoseconds(settings.spin) },
        ticks: settings.ticks.or(settings.seconds.map(|s| (s / robot.dt).round() as u64)),
        longest: settings
            .seconds
            .filter(|_| settings.ticks.is_none() && !robot.is_lockstep())
            .map(|s| clock::nanoseconds(s + GRACE)),
        stop_ticks: (settings.stop_patience / robot.dt).ceil() as u64,
        allocations: settings.allocations,
    }
}

/// The flight log with everything its replay needs but the ticks.
fn open_log(
    robot: &RobotMessage,
    (version, rows): (u64, &[String]),
    core: &CoreSettings,
    settings: &RunSettings,
) -> Result<Option<LogQueue>, LogError> {
    let Some(path) = settings.log.as_deref() else { return Ok(None) };
    let mut facts = settings.metadata.clone();
    facts.extend(crate::log::facts(robot, core, &settings.faults));
    facts.insert("clock".into(), settings.wall.to_string());
    facts.insert("rows".into(), serde_json::json!(rows).to_string());
    let mut log = LogQueue::create(path, &facts, settings.wall)?;
    if !settings.first.is_empty() {
        log.push_snapshot(0, version, settings.first.clone(), rows.to_vec());
    }
    Ok(Some(log))
}

/// Starts the real-time thread and waits for its end.
fn start_cycle<T: LoopController>(
    cycle: Cycle<T>,
    settings: &RunSettings,
) -> Result<(CycleEnd<T>, Vec<String>), RunError> {
    let (tell, told) = sync_channel(1);
    let (wishes, strict) = (settings.thread, settings.strict);
    let thread = spawn("nearl-rt", move || {
        let warnings = prepare(&wishes);
        let refused = strict && !warnings.is_empty();
        let _ = tell.send(warnings);
        if refused { None } else { Some(cycle.run()) }
    })?;
    let warnings = told.recv().unwrap_or_default();
    match thread.join() {
        Ok(Some(end)) => Ok((end, warnings)),
        Ok(None) => Err(RunError::Strict(warnings.join("; "))),
        Err(_) => Err(RunError::Panicked("nearl-rt")),
    }
}

fn spawn<R: Send + 'static>(
    name: &'static str,
    body: impl FnOnce() -> R + Send + 'static,
) -> Result<std::thread::JoinHandle<R>, RunError> {
    std::thread::Builder::new()
        .name(name.into())
        .spawn(body)
        .map_err(|e| RunError::Thread { name, reason: e.to_string() })
}

fn report<B: Build>(
    robot_name: String,
    robot: &RobotMessage,
    sync: Sync,
    begin: u64,
    version: u64,
    end: CycleEnd<B::Controller>,
    mut io: Io<B>,
    mut warnings: Vec<String>,
) -> RunReport {
    let seconds = (clock::now() - begin) as f64 * 1e-9;
    warnings.extend(io.foreign.take().map(|what| {
        format!("a plant came back as another robot, {what}, and got no action: start the one that was there, or the loop with a snapshot made for it")
    }));
    let tally = io.last_tally(end.last.state.tick);
    let path = io.log.as_ref().map(|log| log.path().to_owned());
    let log = io.log.take().map_or_else(LogSummary::default, LogQueue::finish);
    let counters = end.last.counters;
    let refused_snapshots = io.snapshots.refused();
    let mode_count = |mode: Mode| (mode.name(), counters.mode_ticks[mode.code() as usize]);
    RunReport {
        robot: robot_name,
        sync,
        dt: robot.dt,
        seconds,
        ticks: end.last.tick,
        last_mode: end.last.mode,
        reason: match io.gone.load(Ordering::Acquire) {
            true if torn::is_torn() => Reason::MemoryTorn,
            true => Reason::PlantGone,
            false if end.last.tick == 0 => Reason::Stop,
            false => end.last.reason,
        },
        modes: Mode::ALL.iter().copied().map(mode_count).collect(),
        counters,
        statuses: io.watch.statuses(),
        outside: io.watch.outside,
        refused_states: io.traffic.refused_states + io.link.refused_states(),
        wake: percentiles(&end.wake),
        compute: percentiles(&end.compute),
        versions: std::iter::once((0, version)).chain(io.snapshots.accepted).collect(),
        refused_snapshots,
        refusals: io.snapshots.refusals,
        aged: io.traffic.aged,
        log: path,
        log_drops: log.dropped + log.dropped_snapshots,
        log_brief: log.brief,
        log_error: log.error,
        rolled_back: io.snapshots.rolled_back,
        usage: end.usage,
        warnings,
        proposer: io.asked.is_some().then(|| ProposerSummary {
            answer: percentiles(&end.answers.answer),
            link: percentiles(&end.answers.link),
        }),
        plant: plant_summary(&end.last.state, tally.as_ref()),
    }
}

fn plant_summary(state: &StateMessage, tally: Option<&TallyMessage>) -> PlantSummary {
    let none = TallyMessage::zeroed();
    let tally = tally.unwrap_or(&none);
    let measured = || tally.meters().into_iter().filter_map(|(kind, found)| Some((kind, found?)));
    PlantSummary {
        late: state.late,
        watchdog: state.watchdog,
        violations: measured().map(|(kind, (ticks, _))| (kind, ticks)).collect(),
        worst: measured().map(|(kind, (_, excess))| (kind, excess)).collect(),
        not_measured: tally.meters().into_iter().filter(|m| m.1.is_none()).map(|m| m.0).collect(),
        episodes: tally.episodes,
        last_return: tally.last_return,
        episode_return: tally.episode_return,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link::METERS;

    /// Without a tally nothing was measured: that is not the same as 0.
    #[test]
    fn what_a_plant_did_not_measure_is_named_and_has_no_number() {
        let mut state = StateMessage::zeroed();
        (state.late, state.watchdog) = (3, 1);
        let silent = plant_summary(&state, None);
        assert_eq!((silent.late, silent.watchdog), (3, 1));
        assert_eq!(silent.not_measured, METERS);
        assert!(silent.violations.is_empty() && silent.worst.is_empty());
        assert_eq!((silent.episodes, silent.last_return, silent.episode_return), (0, 0.0, 0.0));

        let mut tally = TallyMessage::zeroed();
        tally.measure(1, 7, 0.25);
        (tally.episodes, tally.last_return, tally.episode_return) = (2, -3.5, 1.0);
        let partly = plant_summary(&state, Some(&tally));
        assert_eq!(partly.not_measured, ["position", "acceleration", "torque"]);
        assert_eq!(partly.violations.into_iter().collect::<Vec<_>>(), [("velocity", 7)]);
        assert_eq!(partly.worst.into_iter().collect::<Vec<_>>(), [("velocity", 0.25)]);
        assert_eq!((partly.episodes, partly.last_return, partly.episode_return), (2, -3.5, 1.0));
    }
}
