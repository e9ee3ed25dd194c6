//! Clients that stop, are killed, flood, or belong to another user.

use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use nearl_runtime::link::TrainerLink;
use nearl_trainer::rollout_protocol::*;

use super::{ENDLESS, NAME, PATIENCE, ROLE, beside, snapshot};
use crate::common::*;
use crate::serve_clients::Server;

fn start(role: &str, server: &Server) -> Process {
    let mut command = Command::new(std::env::current_exe().expect("path of the test program"));
    command.args(["--exact", "serve_attack::client", "--ignored", "--nocapture"]);
    Process::start(command.env(ROLE, role).env(NAME, server.0.as_str()))
}

fn said(process: Process) -> String {
    let output = process.output();
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    let line = out.lines().find_map(|l| l.split_once("said "));
    line.unwrap_or_else(|| panic!("{}: {out}{err}", output.status)).1.to_owned()
}

#[test]
fn stopped_clients_lose_their_places_and_are_told_so() {
    let server = Server::start_with("stopped", &["--patience", "2", "--requests", "6"]);
    let stages = ["opened", "asked", "reading", "cancelled", "learning"];
    let stopped = stages.map(|stage| start(stage, &server));
    for (stage, process) in stages.iter().zip(&stopped) {
        let stat = format!("/proc/{}/stat", process.id());
        until(&format!("stopped once {stage}"), || {
            let text = std::fs::read_to_string(&stat).expect("stat of a child");
            text.rsplit(')').next().is_some_and(|rest| rest.trim_start().starts_with('T')).then_some(())
        });
    }
    beside(&server, |_| {
        // All places, with those that the stopped ones had.
        let mut clients: Vec<RolloutClient> = (0..5).map(|_| server.client()).collect();
        let mut taken: Vec<Rollouts> = Vec::new();
        for client in &mut clients {
            let rollouts = until("a place of a stopped client", || {
                // Those that have a place keep it by reading.
                taken.iter_mut().for_each(|other| drop(other.next(PATIENCE).expect("chunk")));
                let mut rollouts = client.request(&Request::new(1, ENDLESS)).expect("request");
                rollouts.next(PATIENCE).ok().map(|_| rollouts)
            });
            taken.push(rollouts);
        }
        drop(taken);
    });
    stopped.iter().for_each(|process| process.signal(libc::SIGCONT));
    for (stage, process) in stages.iter().zip(stopped) {
        if *stage == "opened" {
            // It never had a request; now it has one that nobody ends.
            process.kill();
            continue;
        }
        let said = said(process);
        let words = if *stage == "cancelled" { "the end" } else { "gave this request up" };
        assert!(said.contains(words), "{stage}: {said}");
    }
    server.alone();
    assert_eq!(server.end()["failed"], 0);
}

/// System calls that change what clients and server share.
const CALLS: [&str; 8] =
    ["openat", "mkdir", "ftruncate", "fallocate", "mmap", "write", "fchmod", "unlink,unlinkat"];

/// A client that is killed at the `when`-th call of a kind; true if it got to its end before that.
fn client_killed_at(server: &Server, call: &str, when: usize) -> bool {
    let mut command = Command::new("strace");
    command.args(["-f", "-qq", "-o", "/dev/null", "-e", &format!("trace={call}")]);
    command.args(["-e", &format!("inject={call}:signal=SIGKILL:when={when}")]);
    command.arg(std::env::current_exe().expect("path of the test program"));
    command.args(["--exact", "serve_attack::client", "--ignored"]);
    command.env(ROLE, "whole").env(NAME, server.0.as_str());
    command.stdout(Stdio::null()).stderr(Stdio::null()).status().expect("strace").success()
}

/// Every `NEARL_KILL_STRIDE`-th point (17 by default, 1 for all of them).
#[test]
fn a_client_killed_at_any_system_call_harms_no_other() {
    let traced = Command::new("strace").args(["-qq", "true"]).stderr(Stdio::null()).status();
    if !traced.is_ok_and(|status| status.success()) {
        return skip("clients killed at system calls: strace is missing, or may not trace here");
    }
    let stride = std::env::var("NEARL_KILL_STRIDE").map_or(17, |s| s.parse().expect("NEARL_KILL_STRIDE"));
    let server = Server::start_with("points", &[]);
    let mut points = 0;
    beside(&server, |_| {
        for call in CALLS {
            let mut when = 1 + call.len() % stride;
            while !client_killed_at(&server, call, when) {
                (points, when) = (points + 1, when + stride);
            }
        }
    });
    println!("{points} points");
    assert!(points > 8, "{points}");
    server.alone();
    // Every place for a client is free again.
    let clients: Vec<RolloutClient> = (0..24).map(|_| server.client()).collect();
    drop(clients);
    let report = server.end();
    assert_eq!((&report["failed"], &report["malformed"]), (&0.into(), &0.into()), "{report}");
}

#[test]
fn a_flood_of_requests_and_snapshots_keeps_nobody_from_being_served() {
    let server = Server::start_with("flood", &["--requests", "16"]);
    let bytes = snapshot().to_bytes();
    let mut early = 0;
    beside(&server, |is_served| {
        early = resident(server.process().id());
        let (sent, end) = (AtomicU64::new(0), std::time::Instant::now() + Duration::from_secs(3));
        let goes_on = || std::time::Instant::now() < end || !is_served();
        std::thread::scope(|scope| {
            let (goes_on, sent, server, bytes) = (&goes_on, &sent, &server, &bytes);
            for flooder in 0..8 {
                scope.spawn(move || {
                    let mut client = server.client();
                    while goes_on() {
                        // Asked and left at once: the places are free again, the work of looking at them is not.
                        let asked = match flooder % 2 {
                            0 => client.request_bytes(b"no request"),
                            _ => client.request(&Request::new(1, 0)),
                        };
                        drop(asked.expect("sent"));
                        sent.fetch_add(1, Ordering::Relaxed);
                    }
                });
            }
            scope.spawn(move || {
                let mut link = TrainerLink::open(&server.0).expect("link");
                for version in 1.. {
                    if !goes_on() {
                        break;
                    }
                    link.push(version, bytes).expect("push");
                }
            });
        });
        println!("{} requests dropped at once", sent.into_inner());
    });
    server.alone();
    let late = resident(server.process().id());
    assert!(late < early + 20_000, "{early} kB before the flood, {late} kB after");
    assert_eq!(server.end()["failed"], 0);
}

#[test]
fn another_user_can_neither_ask_nor_harm_the_server() {
    // SAFETY: plain call.
    if unsafe { libc::geteuid() } != 0 {
        return skip("the rollout server and another user: only root can become one");
    }
    let server = Server::start_with("two-users", &[]);
    // What the other user's own links would make, so that it can be taken away again.
    let own = Path::new("/dev/shm/nearl-65534");
    let had = own.exists();
    beside(&server, |_| {
        let mut command = Command::new(std::env::current_exe().expect("path of the test program"));
        command.args(["--exact", "serve_attack::client", "--ignored", "--nocapture"]);
        command.env(ROLE, "stranger").env(NAME, server.0.as_str());
        let stranger =
            Process::start(command.env("NEARL_TEST_ATTACK_PID", server.process().id().to_string()));
        let said = said(stranger);
        assert!(said.contains("no rollout server named"), "{said}");
    });
    let decoy = Path::new("/dev/shm").join(format!("nearl.{}.0000000000000000.decoy", server.0));
    // Whoever cleared up may have taken it away.
    let _ = std::fs::remove_file(decoy);
    if !had {
        let _ = std::fs::remove_dir_all(own);
    }
    server.alone();
    assert_eq!(server.end()["failed"], 0);
}
