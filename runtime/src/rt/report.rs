//! The report of a run: what it counted and measured between start and stop.

use std::collections::BTreeMap;
use std::fmt;
use std::path::PathBuf;

use serde::Serialize;

use crate::percentiles::Percentiles;
use crate::rt::tick::Counters;
use crate::rt::watch::Found;
use crate::rt::{Mode, Reason, Sync};
use crate::thread::Usage;

/// Versions a printed report shows, the last ones; `--json` has all.
const VERSIONS_SHOWN: usize = 12;

/// What the plant said about itself: the link in its last state, limits and episodes in its last tally.
#[derive(Clone, Debug, Default, Serialize)]
pub struct PlantSummary {
    /// Ticks the plant held the last action because none came in time.
    pub late: u64,
    /// Times its watchdog braked.
    pub watchdog: u64,
    /// Ticks that broke a limit in the plant itself, for each kind that it measures.
    pub violations: BTreeMap<&'static str, u64>,
    /// Largest excess over a limit, for each kind that it measures.
    pub worst: BTreeMap<&'static str, f64>,
    /// Kinds of limits that the plant does not measure.
    pub not_measured: Vec<&'static str>,
    /// Episodes finished.
    pub episodes: u64,
    /// Return of the last finished episode.
    pub last_return: f64,
    /// Return of the running episode.
    pub episode_return: f64,
}

/// How quickly another process proposed; how many proposals were taken and lost is in the counters.
#[derive(Clone, Debug, Serialize)]
pub struct ProposerSummary {
    /// From the state it was computed from to the first tick that acts on a proposal.
    pub answer: Percentiles,
    /// From the sending of a proposal to that tick.
    pub link: Percentiles,
}

/// What happened between start and stop.
#[derive(Clone, Debug, Serialize)]
pub struct RunReport {
    /// Robot.
    pub robot: String,
    /// Who kept time.
    pub sync: Sync,
    /// Control period \[s\].
    pub dt: f64,
    /// Duration \[s\].
    pub seconds: f64,
    /// Ticks.
    pub ticks: u64,
    /// Mode of the last tick.
    pub last_mode: Mode,
    /// Why it was not Active.
    pub reason: Reason,
    /// Ticks in each mode.
    pub modes: BTreeMap<&'static str, u64>,
    /// Counts of the loop: overruns, skipped slots, swaps, ticks whose proposal or target broke a limit, and so on.
    pub counters: Counters,
    /// Ticks whose target is not the nearest allowed state to what was proposed, by their status.
    pub statuses: BTreeMap<&'static str, u64>,
    /// What of single joints was found outside its limits where a tick began: the first time each.
    pub outside: Vec<Found>,
    /// States refused for their sizes, their sender or their schema.
    pub refused_states: u64,
    /// From due to begin of the tick.
    pub wake: Percentiles,
    /// From begin of the tick to the action.
    pub compute: Percentiles,
    /// Versions in use: (first tick at the latest, version).
    pub versions: Vec<(u64, u64)>,
    /// Snapshots refused, with the first sentences.
    pub refused_snapshots: u64,
    /// Why they were refused.
    pub refusals: Vec<String>,
    /// Snapshots taken back because the robot no longer reached its targets.
    pub rolled_back: u64,
    /// Times that no new snapshot came for longer than was asked for.
    pub aged: u64,
    /// Page faults, context switches and, where they are counted, allocations of the real-time thread after its first 300 ticks.
    pub usage: Usage,
    /// The flight log; another name than was asked for if that was taken.
    pub log: Option<PathBuf>,
    /// Records the flight log lost.
    pub log_drops: u64,
    /// Ticks of which a disk too slow for all of it has only what replay needs.
    pub log_brief: u64,
    /// Why the flight log stopped, if it did.
    pub log_error: Option<String>,
    /// What the operating system refused: priority, memory, core.
    pub warnings: Vec<String>,
    /// The process that proposed in place of the policy, where one was asked.
    pub proposer: Option<ProposerSummary>,
    /// The plant's own account.
    pub plant: PlantSummary,
}

impl RunReport {
    /// What proposals and targets broke; a policy that proposes nothing breaks nothing either, which says nothing.
    fn projected(&self) -> String {
        let c = &self.counters;
        let counts = format!(
            "by raw proposals in {} ticks, by their targets in {}",
            c.raw_violations, c.target_violations
        );
        let acted = c.mode_ticks[Mode::Active.code() as usize] + c.mode_ticks[Mode::Degraded.code() as usize];
        match c.unprojected {
            0 => counts,
            all if all == acted && all == c.bounded_actions => format!(
                "nothing was projected: the policy gives actions, and only their own limits or the forces of their drives were kept; ticks \
                 with limits on actions broken: asked for {}, given {}",
                c.raw_violations, c.target_violations
            ),
            all if all == acted && c.bounded_actions == 0 => {
                "nothing was projected: the policy gives actions, and no limit was looked at but the actuators' range".into()
            }
            some => format!("{counts}; {some} ticks acted without a projection: their policy gives actions"),
        }
    }
}

impl fmt::Display for RunReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let c = &self.counters;
        writeln!(f, "{}: {} ticks of {} s in {:.1} s", self.robot, self.ticks, self.dt, self.seconds)?;
        let modes: Vec<String> = self.modes.iter().map(|(mode, n)| format!("{mode} {n}")).collect();
        let (last, reason) = (self.last_mode, self.reason);
        writeln!(f, "  modes            {}; ended in {last} ({reason})", modes.join(", "))?;
        writeln!(f, "  wake-up          {}", self.wake)?;
        writeln!(f, "  compute          {}", self.compute)?;
        writeln!(
            f,
            "  timing           overruns {}, skipped {}, late {}, stale {}, states lost {}",
            c.overruns, c.skipped, self.plant.late, c.stale, c.lost_states
        )?;
        let unusable = [
            ("not finite", c.bad_states),
            ("frozen", c.frozen_states),
            ("implausible", c.implausible_states),
            ("out of order", c.out_of_order),
            ("of another robot", self.refused_states),
        ];
        let unusable: Vec<String> =
            unusable.iter().filter(|(_, n)| *n > 0).map(|(what, n)| format!("{what} {n}")).collect();
        if !unusable.is_empty() {
            writeln!(f, "  unusable states  {}", unusable.join(", "))?;
        }
        writeln!(f, "  limits broken    {}", self.projected())?;
        if !self.statuses.is_empty() || c.refused > 0 {
            let refused = (c.refused > 0).then(|| format!("refused {}", c.refused));
            let each = self.statuses.iter().map(|(status, n)| format!("{status} {n}")).chain(refused);
            writeln!(f, "  out of the way   {}", each.collect::<Vec<_>>().join(", "))?;
        }
        for found in &self.outside {
            writeln!(f, "  found outside    {found}")?;
        }
        let measured = self.plant.violations.iter().map(|(kind, n)| format!("{kind} {n}"));
        let others = self.plant.not_measured.iter().map(|kind| format!("{kind} not measured"));
        let plant: Vec<String> = measured.chain(others).collect();
        writeln!(f, "  on the plant     {}", plant.join(", "))?;
        if let Some(proposer) = &self.proposer {
            writeln!(
                f,
                "  proposals        taken {}, overtaken {}, refused {}; ticks on a held one {}, without one {}",
                c.proposals, c.overtaken_proposals, c.refused_proposals, c.held_proposals, c.silent_proposer
            )?;
            writeln!(f, "  state to answer  {}", proposer.answer)?;
            writeln!(f, "  sent to answer   {}", proposer.link)?;
        }
        let u = &self.usage;
        writeln!(
            f,
            "  system           page faults {} + {}, context switches {} asked for ({} for late states), {} forced{}",
            u.minor_faults,
            u.major_faults,
            u.voluntary_switches,
            u.late_waits,
            u.involuntary_switches,
            u.allocations.map_or(String::new(), |n| format!(", {n} allocations"))
        )?;
        let left_out = self.versions.len().saturating_sub(VERSIONS_SHOWN);
        let last: Vec<String> =
            self.versions[left_out..].iter().map(|(_, version)| version.to_string()).collect();
        let earlier = if left_out > 0 { format!("{left_out} earlier, then ") } else { String::new() };
        writeln!(
            f,
            "  snapshots        versions {earlier}{}; refused {}, taken back {}",
            last.join(" "),
            self.refused_snapshots,
            self.rolled_back
        )?;
        if let Some(log) = &self.log {
            let brief =
                if self.log_brief > 0 { format!(", {} in brief", self.log_brief) } else { String::new() };
            writeln!(f, "  flight log       {}, {} records dropped{brief}", log.display(), self.log_drops)?;
        }
        for text in self.refusals.iter().chain(&self.warnings).chain(&self.log_error) {
            writeln!(f, "  note             {text}")?;
        }
        Ok(())
    }
}
