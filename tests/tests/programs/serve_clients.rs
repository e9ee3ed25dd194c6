//! A client that ends takes nothing from other clients and leaves nothing behind in the server.
//!
//! Each test is a case in which iceoryx2 0.10 alone would let a reply, a request or a place be lost.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use crate::common::*;
use nearl_runtime::link::{RobotName, remains, remove_files};
use nearl_trainer::rollout_protocol::*;

const PATIENCE: Duration = Duration::from_secs(60);
const ROLE: &str = "NEARL_TEST_CLIENT_TO_KILL";
const SIGN: &str = "NEARL_TEST_SIGN_OF_LIFE";
/// Far more than any test waits for.
const ENDLESS: u64 = 1_000_000;
/// What a server without clients holds: data of replies and receipts, three services, the counter of nodes; itself.
const ALONE: (usize, usize) = (6, 1);
/// Response buffers of one client: it uses them in turn.
const BUFFERS: usize = 5;

/// A server process with a name of its own; nothing is left of it at the end.
pub(crate) struct Server(pub(crate) RobotName, Option<Process>);

impl Server {
    fn start(what: &str) -> Server {
        Server::start_with(what, &[])
    }

    /// With further options.
    pub(crate) fn start_with(what: &str, options: &[&str]) -> Server {
        let name = RobotName::new(&format!("{what}-{}", std::process::id())).expect("name");
        let panda = panda();
        let arguments = ["serve", panda.to_str().expect("UTF-8"), "--name", name.as_str(), "--json"];
        let process = Process::nearl(&[&arguments, options].concat());
        let server = Server(name, Some(process));
        drop(server.client());
        server
    }

    pub(crate) fn client(&self) -> RolloutClient {
        RolloutClient::open(&self.0, PATIENCE).expect("a server")
    }

    pub(crate) fn process(&self) -> &Process {
        self.1.as_ref().expect("a running server")
    }

    /// Segments in shared memory, and processes that hold them.
    fn held(&self) -> (usize, usize) {
        let prefix = format!("nearl.{}.", self.0);
        let folder = std::fs::read_dir("/dev/shm").expect("/dev/shm");
        let segments =
            folder.flatten().filter(|f| f.file_name().to_string_lossy().starts_with(&prefix)).count();
        let holders = remains().into_iter().find(|r| r.name == self.0.as_str());
        (segments, holders.map_or(0, |r| r.alive + r.dead))
    }

    /// Waits until nothing of any client is left.
    pub(crate) fn alone(&self) {
        let mut last = (0, 0);
        until("the server alone", || {
            let held = self.held();
            if held != last {
                println!("segments and holders: {held:?}");
                last = held;
            }
            (held == ALONE).then_some(())
        });
    }

    pub(crate) fn end(mut self) -> serde_json::Value {
        self.1.take().expect("a running server").end()
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        drop(self.1.take());
        remove_files(&self.0);
    }
}

/// A client process that reads until it is killed.
fn reader(server: &Server) -> Process {
    let sign = PathBuf::from(format!("/dev/shm/sign-{}", server.0));
    let _ = std::fs::remove_file(&sign);
    let mut command = Command::new(std::env::current_exe().expect("path of the test program"));
    let command = command.args(["--exact", "serve_clients::client", "--ignored"]);
    let reader = Process::start(command.env(ROLE, server.0.as_str()).env(SIGN, &sign));
    until("the client reads", || sign.exists().then_some(()));
    std::fs::remove_file(&sign).expect("the sign");
    reader
}

/// Not a test of its own: what [`reader`] starts.
#[test]
#[ignore = "started by another test as a process of its own"]
fn client() {
    let (Ok(name), Ok(sign)) = (std::env::var(ROLE), std::env::var(SIGN)) else { return };
    let mut client = RolloutClient::open(&RobotName::new(&name).expect("name"), PATIENCE).expect("a server");
    let mut rollouts = client.request(&Request::new(1, ENDLESS)).expect("request");
    rollouts.next(PATIENCE).expect("chunk").expect("chunk");
    std::fs::write(Path::new(&sign), "").expect("the sign");
    while let Ok(Some(_)) = rollouts.next(PATIENCE) {}
}

fn is_bad_request(answer: &Result<Option<Chunk>, RequestError>) -> bool {
    matches!(answer, Err(RequestError::Refused { answer: Answer::BadRequest, .. }))
}

#[test]
fn a_refusal_waits_for_room_in_a_buffer_that_was_never_read() {
    let server = Server::start("refusal");
    let mut client = server.client();
    for _ in 0..BUFFERS {
        let unread = client.request(&Request::new(1, ENDLESS)).expect("request");
        std::thread::sleep(Duration::from_millis(400)); // so that the server fills the buffer
        drop(unread);
    }
    for _ in 0..2 * BUFFERS {
        let mut refused = client.request_bytes(b"no request").expect("sent");
        std::thread::sleep(Duration::from_millis(20)); // so that the server meets the full buffer
        let answer = refused.next(PATIENCE);
        assert!(is_bad_request(&answer), "{answer:?}");
    }
    drop(client);
    let report = server.end();
    assert_eq!(report["malformed"], 2 * BUFFERS, "{report}");
}

#[test]
fn a_request_waits_for_a_server_that_is_behind() {
    let server = Server::start("behind");
    let mut client = server.client();
    server.process().signal(libc::SIGSTOP);
    // Both places in the server's request buffer are taken, and their streams are dropped.
    (0..2).for_each(|seed| drop(client.request(&Request::new(seed, 1)).expect("request")));
    std::thread::scope(|scope| {
        scope.spawn(|| {
            std::thread::sleep(Duration::from_millis(300));
            server.process().signal(libc::SIGCONT);
        });
        let mut rollouts = client.request(&Request::new(1, 3)).expect("a request that waits");
        while rollouts.next(PATIENCE).expect("chunk").is_some() {}
        assert_eq!(rollouts.steps(), 3);
    });
    server.end();
}

#[test]
fn a_new_client_in_the_place_of_a_killed_one_gets_its_own_answers() {
    let server = Server::start("place");
    for _ in 0..10 {
        let first = reader(&server);
        server.process().signal(libc::SIGSTOP);
        first.kill();
        // Has the place of the first in the list of clients, and asks for the first time, too.
        let mut client = server.client();
        let mut rollouts = client.request(&Request::new(2, ENDLESS)).expect("request");
        server.process().signal(libc::SIGCONT);
        // Longer than the server needs to find out who died.
        let end = Instant::now() + Duration::from_millis(700);
        while Instant::now() < end {
            rollouts.next(PATIENCE).expect("chunk").expect("chunk");
        }
    }
    server.end();
}

#[test]
fn requests_of_clients_that_left_before_they_were_read_leave_nothing() {
    let server = Server::start("unread");
    for _ in 0..150 {
        let mut client = server.client();
        let answer =
            client.request_bytes(b"so that the server knows the client").expect("sent").next(PATIENCE);
        assert!(is_bad_request(&answer), "{answer:?}");
        server.process().signal(libc::SIGSTOP);
        drop(client.request(&Request::new(1, 1)).expect("request"));
        drop(client);
        server.process().signal(libc::SIGCONT);
    }
    // One more leaves with its request under way, for which the server must find room, too.
    reader(&server).kill();
    drop(server.client());
    server.alone();
    assert_eq!(server.end()["malformed"], 150);
}
