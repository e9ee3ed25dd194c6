//! `nearl plant`: MuJoCo as the robot, over shared memory.

use super::{Failure, of_file, say};
use crate::blank::complete;
use crate::plant::MujocoPlant;
use crate::tasks;
use clap::Args;
use nearl_runtime::cli::{Ended, LOOP_GONE, MEMORY_TORN};
use nearl_runtime::link::{METERS, PlantLink, PlantReport, PlantRunner, PlantSettings, RobotName};
use nearl_runtime::rt::{FaultPlan, FaultyPlant, Reason, Stop};
use nearl_runtime::snapshot::in_run;
use nearl_runtime::task::IdmKind;
use nearl_runtime::{Manifest, PolicyKind, Snapshot};
use std::collections::BTreeMap;
use std::io::Write;
use std::path::Path;

#[derive(Args)]
pub(super) struct PlantCommand {
    /// Task name (see `nearl tasks`), TOML file, or snapshot: also of a robot without a reward, as an imported policy's.
    task: String,
    /// Name of the robot; the runtime says the same with `--plant`.
    #[arg(long)]
    name: String,
    /// Stop by itself after this time of the robot's own clock in [s], counted in control periods. With --lockstep that clock stands still while no
    /// runtime answers: without one the plant waits for ever, unless --loop-patience says how long.
    #[arg(long, value_parser = nearl_runtime::cli::seconds)]
    seconds: Option<f64>,
    /// Wait for the action of every state instead of keeping real time; --loop-patience ends a wait that is too long.
    #[arg(long)]
    lockstep: bool,
    /// SCHED_FIFO priority, 1 to 99, if the system allows it; best that of the runtime.
    #[arg(long, value_parser = clap::value_parser!(i32).range(1..=99), conflicts_with = "lockstep")]
    priority: Option<i32>,
    /// End with exit code 4 after so long without an action, instead of waiting for the next runtime [s].
    #[arg(long, value_parser = nearl_runtime::cli::seconds)]
    loop_patience: Option<f64>,
    /// Let the robot go on instead of starting episodes anew.
    #[arg(long)]
    endless: bool,
    /// Seed of the initial states.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Rehearse the sensor faults in this JSON file.
    #[arg(long)]
    faults: Option<std::path::PathBuf>,
    /// Overrides of the task file; of a snapshot those sections that say what is simulated, as `random.mass=1.2`.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

impl PlantCommand {
    pub(super) fn run(self) -> Result<(), Failure> {
        let manifest = self.manifest()?;
        let plan = self.faults.as_deref().map(FaultPlan::load).transpose()?.unwrap_or_default();
        let plant = MujocoPlant::new(&manifest, self.seed, !self.endless)?;
        let dt = plant.dt();
        let time = &manifest.task.time;
        let analytic = manifest.policy != PolicyKind::Direct && manifest.task.idm.kind == IdmKind::Pinocchio;
        let counts = time.sim_dt == 0.0 && (manifest.guards() || analytic);
        if let Some(step) = plant.sim_dt().filter(|_| counts) {
            nearl_runtime::tell!(
                "nearl: the task counts on forces without steps (time.sim_dt is 0), and this simulation has steps of {step} s: limits hold but for the \
                 difference; with time.sim_dt = {step} they are exact here"
            );
        }
        let name = RobotName::new(&self.name)?;
        let link = PlantLink::open(&name, &plant.robot(self.lockstep))?;
        let mut settings =
            if self.lockstep { PlantSettings::lockstep(dt) } else { PlantSettings::simulator(dt) };
        settings.priority = self.priority;
        settings.loop_patience = self.loop_patience;
        settings.ticks = self.seconds.map(|s| (s / dt).round() as u64);
        let stop = Stop::on_signals()?;
        if !self.json {
            // A closed output is no reason not to move: the robot does not depend on who reads.
            let hertz = 1.0 / dt;
            let _ = writeln!(
                std::io::stdout(),
                "{} as '{name}', {hertz:.0} Hz; start the runtime with --plant {name}",
                self.task
            );
        }
        let mut faulty = FaultyPlant::new(plant, plan);
        let report = PlantRunner::new(link, settings)?.run(&mut faulty, &stop);
        let found: Vec<_> = METERS.into_iter().zip(faulty.plant.meter().records()).collect();
        if self.json {
            let measured = || found.iter().filter_map(|(kind, w)| Some((*kind, (*w)?)));
            let violations: BTreeMap<_, _> = measured().map(|(kind, w)| (kind, w.states)).collect();
            let worst: BTreeMap<_, _> = measured().map(|(kind, w)| (kind, w.excess)).collect();
            let not_measured: Vec<_> =
                found.iter().filter(|(_, w)| w.is_none()).map(|(kind, _)| kind).collect();
            say(
                serde_json::json!({ "report": report, "violations": violations, "worst": worst, "not_measured": not_measured }),
            );
            return ended(&report, &name);
        }
        say(format!(
            "{} ticks, {} late, {} braked, watchdog {}",
            report.ticks, report.late, report.braked, report.watchdog
        ));
        for ((what, found), unit) in found.into_iter().zip(["rad", "rad/s", "rad/s^2", "N m"]) {
            say(match found {
                Some(w) => {
                    format!(
                        "{what:<12} limit broken in {} ticks, by at most {:.3e} {unit}",
                        w.states, w.excess
                    )
                }
                None => format!("{what:<12} not measured"),
            });
        }
        ended(&report, &name)
    }
}

impl PlantCommand {
    /// The robot and its task.
    fn manifest(&self) -> Result<Manifest, Failure> {
        let file = in_run(Path::new(&self.task));
        if file.extension().is_some_and(|e| e == "safetensors") {
            let mut snapshot = Snapshot::load(&file)?;
            let why = "the plant of a snapshot changes what is simulated and no controller";
            super::eval::changed(&mut snapshot, &self.set, &super::eval::SIMULATED, why)?;
            return Ok(snapshot.manifest);
        }
        let mut manifest = tasks::load(&self.task, &self.set)?;
        complete(&mut manifest).map_err(|e| of_file(&self.task, &e))?;
        Ok(manifest)
    }
}

/// What ended the plant by itself, with its exit code.
fn ended(report: &PlantReport, name: &RobotName) -> Result<(), Failure> {
    match (report.memory_torn, report.loop_gone) {
        (true, _) => Err(Ended::failure(MEMORY_TORN, Reason::MemoryTorn, name.as_str())),
        (_, true) => Err(Ended::failure(LOOP_GONE, Reason::LoopGone, name.as_str())),
        _ => Ok(()),
    }
}
