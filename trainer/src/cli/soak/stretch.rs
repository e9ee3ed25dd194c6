//! One stretch of the soak: what was measured, and which promises it kept.

use crate::cli::{Failure, say};
use nearl_runtime::Snapshot;
use nearl_runtime::net::{Dense, DenseLayer};
use nearl_runtime::rt::RunReport;
use serde_json::{Value, json};

/// What one stretch at one rate gave.
pub(super) struct Stretch {
    pub(super) rate: f64,
    pub(super) run: RunReport,
    pub(super) plant: Value,
    pub(super) empty: Value,
    pub(super) swaps: Swaps,
    pub(super) replay: Value,
}

#[derive(Default)]
pub(super) struct Swaps {
    pub(super) pushed: u64,
    pub(super) accepted: u64,
    pub(super) superseded: u64,
    pub(super) others: Vec<String>,
}

impl Stretch {
    /// Share of ticks that ended late or whose action the plant missed.
    pub(super) fn late_share(&self) -> f64 {
        let late = self.plant["report"]["late"].as_u64().unwrap_or(u64::MAX);
        (self.run.counters.overruns.max(late)) as f64 / self.run.ticks.max(1) as f64
    }

    /// Each promise and whether it was kept; without a log nothing is said of the replay.
    pub(super) fn kept(&self) -> Value {
        let (run, c) = (&self.run, &self.run.counters);
        let states: u64 = run.modes.values().sum();
        let mut kept = json!({
            "projected targets within limits": c.target_violations == 0,
            "plant within limits": self.plant["violations"].as_object().is_some_and(|v| v.values().all(|n| n == 0)),
            "no allocation": run.usage.allocations == Some(0),
            "no page fault": (run.usage.minor_faults, run.usage.major_faults) == (0, 0),
            "at most one voluntary switch a tick whose state was in time": run.usage.voluntary_switches <= run.ticks + run.usage.late_waits,
            "every tick has one mode": states == run.ticks,
            "no action or record lost in the loop": (c.dropped_actions, c.dropped_records) == (0, 0),
            "no snapshot refused": run.refused_snapshots == 0 && self.swaps.others.is_empty(),
        });
        if !self.replay.is_null() {
            let equal = self.replay["difference"].is_null() && self.replay["ticks"] == run.ticks;
            kept["replay bit-equal"] = equal.into();
        }
        kept
    }

    /// What must hold on any machine, however loaded, and did not: one sentence each. Limits are among it unless the plant missed an
    /// action and held an old one, which no loop can undo.
    pub(super) fn broken(&self) -> Vec<String> {
        let report = &self.plant["report"];
        let was_served = report["late"] == 0 && report["watchdog"] == 0;
        let limits = ["projected targets within limits", "plant within limits"];
        let always = ["no allocation", "every tick has one mode"].into_iter();
        let all = always.chain(limits.into_iter().filter(|_| was_served));
        let kept = self.kept();
        let broken = all.filter(|what| kept[*what] == false);
        broken.map(|what| format!("not kept: {what}; see soak.json and the flight log")).collect()
    }

    pub(super) fn json(&self) -> Value {
        let s = &self.swaps;
        json!({
            "rate_hz": self.rate, "run": self.run, "plant": self.plant, "empty_loop_wake_ns": self.empty,
            "late_share": self.late_share(), "replay": self.replay,
            "swaps": { "pushed": s.pushed, "accepted": s.accepted, "superseded": s.superseded, "others": s.others },
        })
    }

    pub(super) fn print(&self) {
        say(self.run.to_string().trim_end());
        let us = |key: &str| self.empty[key].as_f64().unwrap_or(f64::NAN) * 1e-3;
        say(format!(
            "  empty loop       p50 {:>8.1}  p99 {:>8.1}  p99.9 {:>8.1}  max {:>9.1} us  (wake-up, same load)",
            us("p50"),
            us("p99"),
            us("p999"),
            us("max")
        ));
        let s = &self.swaps;
        say(format!(
            "  swaps            {} pushed, {} accepted, {} superseded",
            s.pushed, s.accepted, s.superseded
        ));
        say(format!("  plant            {}", self.plant));
        if !self.replay.is_null() {
            say(format!("  replay           {}", self.replay));
        }
        for (what, kept) in self.kept().as_object().into_iter().flatten() {
            say(format!("  {} {what}", if *kept == true { "kept    " } else { "NOT KEPT" }));
        }
    }
}

/// The same policy and limits at another control rate, the policy's own rate as near as it can be.
pub(super) fn at_rate(snapshot: &Snapshot, rate: f64) -> Result<Snapshot, Failure> {
    if !(1.0..=100_000.0).contains(&rate) {
        return Err(format!("--rate {rate} Hz: give 1 to 100000 Hz").into());
    }
    let mut snapshot = snapshot.clone();
    let time = &mut snapshot.manifest.task.time;
    let policy = time.dt * time.policy_every as f64;
    if (rate * time.dt - 1.0).abs() > 1e-9 {
        let sub_steps = if time.sim_dt == 0.0 { 0.0 } else { (time.dt / time.sim_dt).round() };
        time.dt = 1.0 / rate;
        time.sim_dt = if sub_steps == 0.0 { 0.0 } else { time.dt / sub_steps };
        time.policy_every = ((policy * rate).round() as usize).max(1);
    }
    Ok(snapshot)
}

/// Weights that no robot with analytic inverse dynamics reads, but that are sent, checked and built.
pub(super) fn ballast(megabytes: usize) -> (Dense, Vec<f32>) {
    let (n_in, n_out) = (1000, 250 * megabytes);
    let layer = DenseLayer { n_in, n_out, weight: vec![0.5; n_in * n_out], bias: vec![0.0; n_out] };
    (Dense { layers: vec![layer], skip: None }, vec![0.0; n_out])
}

/// The policy that wants the reverse.
pub(super) fn opposite(snapshot: &Snapshot) -> Snapshot {
    let mut opposite = snapshot.clone();
    if let Some(last) = opposite.networks.policy.layers.last_mut() {
        last.weight.iter_mut().chain(&mut last.bias).for_each(|w| *w = -*w);
    }
    opposite
}
