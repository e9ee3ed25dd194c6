//! `nearl bench serve`: rollouts over shared memory beside as many collected in this process.

use super::{Failure, at_least_one, cores, say};
use crate::rollout::Collector;
use crate::run_folder;
use crate::serve::{Settings, serve};
use clap::Args;
use nearl_rollout_protocol::{Request, RequestError, RolloutClient};
use nearl_runtime::Snapshot;
use nearl_runtime::link::{RobotName, remove_files};
use nearl_runtime::rt::Stop;
use std::path::PathBuf;
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

/// Longest wait for the server.
const PATIENCE: Duration = Duration::from_secs(60);

#[derive(Args)]
pub(super) struct ServeBench {
    /// Snapshot file or run folder.
    snapshot: PathBuf,
    /// Clients, and environments of the collection beside it.
    #[arg(long, default_value_t = 4)]
    clients: usize,
    /// Policy steps of each client in a round.
    #[arg(long, default_value_t = 4000)]
    steps: usize,
    /// Rounds, alternating.
    #[arg(long, default_value_t = 5)]
    repeat: usize,
    /// Threads of both; all cores if not given.
    #[arg(long, value_parser = at_least_one)]
    threads: Option<usize>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// Processor time of this process, all threads \[s\]: it says more than the clock where others use the machine.
fn processor() -> f64 {
    let mut time = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: writes the struct it is given; the clock exists on every Linux.
    unsafe { libc::clock_gettime(libc::CLOCK_PROCESS_CPUTIME_ID, &raw mut time) };
    time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
}

/// Steps per second of the clock, and of processor time.
fn rates<E>(steps: f64, run: impl FnOnce() -> Result<(), E>) -> Result<[f64; 2], E> {
    let (start, used) = (Instant::now(), processor());
    run()?;
    Ok([steps / start.elapsed().as_secs_f64(), steps / (processor() - used)])
}

/// Reads `steps` policy steps to the end.
fn read(client: &mut RolloutClient, seed: u64, steps: u64) -> Result<(), RequestError> {
    let mut rollouts = client.request(&Request::new(seed, steps))?;
    while rollouts.next(PATIENCE)?.is_some() {}
    Ok(())
}

impl ServeBench {
    pub(super) fn run(self) -> Result<(), Failure> {
        if self.clients == 0 || self.steps == 0 || self.clients > 16 {
            return Err(format!(
                "--clients {} and --steps {}: give 1 to 16 clients and at least 1 step",
                self.clients, self.steps
            )
            .into());
        }
        let file = run_folder::snapshot_of(&self.snapshot)?;
        let snapshot = Snapshot::load(&file).map_err(|e| format!("{}: {e}", file.display()))?;
        let name = RobotName::new(&format!("bench-serve-{}", std::process::id()))?;
        let rounds = self.measure(&snapshot, &name);
        remove_files(&name);
        self.print(&snapshot, rounds?);
        Ok(())
    }

    /// Served and collected steps per second, by the clock and by processor time, round by round.
    fn measure(&self, snapshot: &Snapshot, name: &RobotName) -> Result<Vec<[[f64; 2]; 2]>, Failure> {
        let threads = self.threads.unwrap_or_else(cores).max(1);
        let mut collector = Collector::new(snapshot, 0..self.clients, self.steps, threads, 0.99, 0)?;
        let settings = Settings {
            threads,
            requests: self.clients,
            max_steps: self.steps as u64,
            max_envs: 1,
            patience: PATIENCE,
        };
        let (stop, (ready, wait)) = (Stop::new(), channel());
        let total = (self.clients * self.steps) as f64;
        std::thread::scope(|scope| {
            // Who no longer waits has failed already, and says so.
            let begin = move || ready.send(()).unwrap_or_default();
            let server = scope.spawn(|| serve(snapshot, name, &settings, &stop, begin));
            let rounds = wait.recv().map_err(|_| Failure::from("")).and_then(|()| {
                let open = || RolloutClient::open(name, PATIENCE);
                let mut clients = (0..self.clients).map(|_| open()).collect::<Result<Vec<_>, _>>()?;
                (0..self.repeat.max(1))
                    .map(|_| {
                        let collected = rates(total, || Ok::<_, Failure>(collector.collect()?))?;
                        let served = rates(total, || read_all(&mut clients, self.steps as u64))?;
                        Ok([served, collected])
                    })
                    .collect()
            });
            stop.request();
            match server.join() {
                Ok(Ok(_)) => rounds,
                Ok(Err(e)) => Err(e.into()),
                Err(_) => Err("the server's thread panicked: report it with the message above".into()),
            }
        })
    }

    fn print(&self, snapshot: &Snapshot, rounds: Vec<[[f64; 2]; 2]>) {
        let median = |number: &dyn Fn(&[[f64; 2]; 2]) -> f64| {
            let mut all: Vec<f64> = rounds.iter().map(number).collect();
            all.sort_by(f64::total_cmp);
            all[all.len() / 2]
        };
        let rate = |what: usize, clock: usize| median(&|r| r[what][clock]);
        let ratio = |clock: usize| median(&|r| r[0][clock] / r[1][clock]);
        let (task, clients) = (&snapshot.manifest.task.name, self.clients);
        if self.json {
            return say(serde_json::json!({ "task": task, "clients": clients, "rounds": rounds.len(),
                "served_steps_per_s": rate(0, 0), "collected_steps_per_s": rate(1, 0), "ratio": ratio(0),
                "served_steps_per_processor_s": rate(0, 1), "collected_steps_per_processor_s": rate(1, 1), "processor_ratio": ratio(1) }));
        }
        for (clock, per) in ["s", "processor s"].iter().enumerate() {
            let (served, collected, ratio) = (rate(0, clock), rate(1, clock), 100.0 * ratio(clock));
            say(format!(
                "{task}, {clients} clients: served {served:.0} steps/{per}, \
                 collected in this process {collected:.0} steps/{per}: {ratio:.0} % (median of {} rounds)",
                rounds.len()
            ));
        }
    }
}

/// Every client reads its request at the same time.
fn read_all(clients: &mut [RolloutClient], steps: u64) -> Result<(), Failure> {
    std::thread::scope(|scope| {
        let reading: Vec<_> = clients
            .iter_mut()
            .enumerate()
            .map(|(seed, client)| scope.spawn(move || read(client, seed as u64, steps)))
            .collect();
        reading.into_iter().try_for_each(|reader| match reader.join() {
            Ok(result) => result.map_err(Failure::from),
            Err(_) => Err("a client's thread panicked: report it with the message above".into()),
        })
    })
}
