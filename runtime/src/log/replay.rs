//! `nearl replay`: every tick of a flight log computed again, bit for bit.
//!
//! State, times, stop and swaps are taken from the log; modes, proposals, targets, ledgers, actions and counts are
//! computed by the functions the loop itself calls ([`Core`]) and compared.

use std::collections::{BTreeMap, HashMap};
use std::fmt;
use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use mcap::read::parse_record;
use mcap::records::Record as Part;
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use serde::Serialize;
use serde_json::Value;

use super::brief::{BriefJson, MemoryJson, digest};
use super::facts::{self, Session};
use super::tick::{TickJson, encode};
use super::writer::{
    BRIEF_TOPIC, MEMORY_TOPIC, SNAPSHOT_TOPIC, SnapshotNumbered, TICK_TOPIC, attachment_name,
};
use crate::link::{Message, ProposalMessage, RobotMessage, SnapshotBytes, SnapshotHeader, StateMessage};
use crate::rt::{Build, Core, Inputs, Loaded, PilotBuilder, Record};
use crate::snapshot::one_line;

/// Bytes read at a time: a log may be larger than memory.
const PORTION: usize = 1 << 20;

/// What replay found.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Replay {
    /// Ticks computed again with the same bits.
    pub ticks: u64,
    /// Controllers swapped in on the way.
    pub swaps: u64,
    /// Those of them of which the log has only what replay needs.
    pub brief: u64,
    /// Ticks that the log lost, and those after them up to the next memory.
    pub gaps: Vec<Gap>,
    /// The log was closed by the runtime, not cut by its death or later.
    pub complete: bool,
    /// Where log and replay first differ.
    pub difference: Option<Difference>,
}

/// Ticks that could not be computed again: the log lost some of them, and what the loop remembered.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Gap {
    /// First of them.
    pub from: u64,
    /// Last of them, after which replay went on; the last of the log if it did not.
    pub to: u64,
    /// How many of them the log does not have.
    pub lost: u64,
}

/// The first tick and field that differ.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Difference {
    /// Tick.
    pub tick: u64,
    /// Field of the tick, for example `action[3]`.
    pub field: String,
    /// Its value in the log.
    pub log: String,
    /// Its value in the replay.
    pub replay: String,
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Difference { tick, field, log, replay } = self;
        write!(f, "tick {tick}: `{field}` is {log} in the log, replay gives {replay}")
    }
}

/// Why a log cannot be replayed.
#[derive(Debug, thiserror::Error)]
#[error(
    "flight log '{file}' cannot be replayed: {reason}; give a file written by `nearl run --log` of this build"
)]
pub struct ReplayError {
    file: PathBuf,
    reason: String,
}

/// Replays the log in `file`.
///
/// # Errors
/// [`ReplayError`] if it is no flight log of this build, or a snapshot in it is refused.
pub fn replay(file: &Path) -> Result<Replay, ReplayError> {
    replay_with(file, PilotBuilder::default())
}

/// The same with controllers made by `build`.
///
/// # Errors
/// As [`replay`].
pub fn replay_with<B: Build>(file: &Path, build: B) -> Result<Replay, ReplayError> {
    // What is quoted from a damaged file may hold line breaks.
    let fail =
        |reason: String| ReplayError { file: file.to_owned(), reason: reason.replace(['\n', '\r'], " ") };
    let (log, length) = open(file).map_err(|e| fail(e.to_string()))?;
    let mut found = Replayer::new(build).run(log, length).map_err(fail)?;
    found.complete &= ends_whole(file).map_err(|e| fail(e.to_string()))?;
    Ok(found)
}

/// Whether the file ends as MCAP ends, and there for the first time: a part of its end may be missing that no tick is in, or a log was added to it.
fn ends_whole(file: &Path) -> io::Result<bool> {
    let mut log = BufReader::new(nearl_constraints::open_regular(file, true)?);
    let length = log.get_ref().metadata()?.len();
    let mut at = mcap::MAGIC.len() as u64;
    loop {
        let mut head = [0; 9]; // a part's opcode and length
        if at >= length {
            return Ok(false);
        }
        log.seek(SeekFrom::Start(at))?;
        if log.read_exact(&mut head).is_err() {
            return Ok(false);
        }
        let [opcode, size @ ..] = head;
        at = at.saturating_add(head.len() as u64).saturating_add(u64::from_le_bytes(size));
        if opcode == mcap::records::op::FOOTER {
            break;
        }
    }
    let mut end = [0; mcap::MAGIC.len()];
    if at.saturating_add(end.len() as u64) != length {
        return Ok(false);
    }
    log.seek(SeekFrom::Start(at))?;
    Ok(log.read_exact(&mut end).is_ok() && end == *mcap::MAGIC)
}

/// What is said of a log that another program wrote anew.
fn compressed(format: &str) -> String {
    format!(
        "its chunks are compressed with {}, which this program does not read: write it without compression, or with lz4",
        one_line(&format)
    )
}

/// The log to be read from its start, and its length.
fn open(file: &Path) -> io::Result<(BufReader<File>, usize)> {
    let file = nearl_constraints::open_regular(file, true)?;
    match file.metadata()?.len() as usize {
        0 => Err(io::Error::other("it is empty")),
        length => Ok((BufReader::with_capacity(PORTION, file), length)),
    }
}

struct Replayer<B: Build> {
    build: B,
    topics: HashMap<u16, String>,
    facts: BTreeMap<String, String>,
    attachments: HashMap<String, Vec<u8>>,
    snapshots: HashMap<u64, SnapshotNumbered>,
    running: Option<(Session, Core<B::Controller>)>,
    line: Vec<u8>,
    /// The tick read last.
    at: u64,
    /// The gap that replay is in, and the tick read last, from which it may go on.
    gap: Option<Gap>,
    last: Option<Box<Record>>,
    found: Replay,
}

/// What a tick's message says beside what is computed.
struct Given<'a> {
    tick: u64,
    due: u64,
    begin: u64,
    end: u64,
    snapshot: u64,
    has_state: bool,
    swapped: bool,
    stop: bool,
    duration: u64,
    dropped: (u64, u64),
    state: &'a StateMessage,
    proposal: Option<&'a ProposalMessage>,
}

/// [`Given`] of a message, whole or in brief, which call the same things by the same names.
macro_rules! given {
    ($json:ident, $($own:ident: $value:expr,)*) => {
        Given {
            tick: $json.tick,
            due: $json.due_ns,
            begin: $json.begin_ns,
            end: $json.end_ns,
            snapshot: $json.snapshot,
            has_state: $json.fresh || $json.ignored,
            swapped: $json.swapped,
            stop: $json.stop,
            $($own: $value,)*
        }
    };
}

impl<B: Build> Replayer<B> {
    fn new(build: B) -> Self {
        Replayer {
            build,
            topics: HashMap::new(),
            facts: BTreeMap::new(),
            attachments: HashMap::new(),
            snapshots: HashMap::new(),
            running: None,
            line: Vec::new(),
            at: 0,
            gap: None,
            last: None,
            found: Replay {
                ticks: 0,
                swaps: 0,
                brief: 0,
                gaps: Vec::new(),
                complete: false,
                difference: None,
            },
        }
    }

    fn run(mut self, mut log: impl Read, length: usize) -> Result<Replay, String> {
        // No part is longer than the file: a damaged length is refused before memory is taken for it.
        let options = LinearReaderOptions::default()
            .with_skip_end_magic(true)
            .with_validate_chunk_crcs(true)
            .with_record_length_limit(length);
        let mut reader = LinearReader::new_with_options(options);
        while let Some(event) = reader.next_event() {
            let part = match event {
                Ok(LinearReadEvent::ReadRequest(wanted)) => {
                    let read = log.read(reader.insert(wanted.min(PORTION))).map_err(|e| e.to_string())?;
                    reader.notify_read(read);
                    continue;
                }
                Ok(LinearReadEvent::Record { data, opcode }) => parse_record(opcode, data),
                Err(e) => Err(e),
            };
            match part {
                Ok(Part::DataEnd(_)) => self.found.complete = true,
                // A chunk's checksum comes after its content: that a difference is none of the loop, but damage of the file, is known there.
                Ok(_) if self.found.difference.is_some() => {}
                Ok(part) => self.take(part)?,
                // A runtime that was killed leaves its last chunk unfinished.
                Err(mcap::McapError::UnexpectedEof | mcap::McapError::UnexpectedEoc) => break,
                Err(mcap::McapError::UnsupportedCompression(format)) => return Err(compressed(&format)),
                // The reader is given bytes, and reads none itself.
                Err(mcap::McapError::Io(_) | mcap::McapError::DecompressionError(_)) => {
                    return Err("a chunk of it is damaged, and cannot be unpacked".into());
                }
                Err(e) => return Err(one_line(&e)),
            }
        }
        if self.at == 0 {
            return Err("it holds no ticks".into());
        }
        self.found.gaps.extend(self.gap.take());
        Ok(self.found)
    }

    fn take(&mut self, part: Part<'_>) -> Result<(), String> {
        match part {
            Part::Channel(channel) => {
                self.topics.insert(channel.id, channel.topic);
            }
            Part::Metadata(metadata) => self.facts.extend(metadata.metadata),
            Part::Attachment { header, data, .. } => {
                self.attachments.insert(header.name, data.into_owned());
            }
            Part::Message { header, data } => match self.topics.get(&header.channel_id).map(String::as_str) {
                Some(TICK_TOPIC) => self.tick(&data)?,
                Some(BRIEF_TOPIC) => self.brief(&data)?,
                Some(MEMORY_TOPIC) => self.memory(&data)?,
                Some(SNAPSHOT_TOPIC) => {
                    let numbered: SnapshotNumbered =
                        serde_json::from_slice(&data).map_err(|e| one_line(&e))?;
                    self.snapshots.insert(numbered.id, numbered);
                }
                _ => {}
            },
            _ => {}
        }
        Ok(())
    }

    /// A whole tick: everything in it is compared.
    fn tick(&mut self, logged: &[u8]) -> Result<(), String> {
        if self.running.is_none() {
            facts::check_schema(&self.facts)?;
        }
        let at = self.at + 1;
        let damaged = |e| format!("the message of tick {at} is damaged: {}", one_line(&e));
        let json = serde_json::from_slice::<TickJson<'_>>(logged).map_err(damaged)?;
        let too_long = |what: &str| format!("a {what} of tick {} is too long", json.tick);
        let record = json.record().ok_or_else(|| too_long("vector"))?;
        let proposal = json.proposal().ok_or_else(|| too_long("proposal"))?;
        let given = given!(json,
            duration: json.duration(),
            dropped: (json.counters.dropped_actions, json.counters.dropped_records),
            state: &record.state,
            proposal: proposal.as_ref(),
        );
        if self.advance(&given)? {
            self.compare(json.tick, logged)?;
        }
        let mut record = record;
        record.snapshot = json.snapshot;
        self.last = Some(Box::new(record));
        Ok(())
    }

    /// A tick in brief: a digest over everything in it is compared.
    fn brief(&mut self, logged: &[u8]) -> Result<(), String> {
        let at = self.at + 1;
        let damaged = |e| format!("the brief message of tick {at} is damaged: {}", one_line(&e));
        let json = serde_json::from_slice::<BriefJson<'_>>(logged).map_err(damaged)?;
        let state =
            json.state.message().ok_or_else(|| format!("a vector of tick {} is too long", json.tick))?;
        let given = given!(json,
            duration: json.duration_ns,
            dropped: (json.dropped_actions, json.dropped_records),
            state: &state,
            proposal: None, // a tick that one came in is written whole
        );
        if self.advance(&given)? {
            let own = digest(&self.line);
            match own == json.digest {
                true => (self.found.ticks, self.found.brief) = (self.found.ticks + 1, self.found.brief + 1),
                false => self.differ(json.tick, "digest", json.digest.into_owned(), own),
            }
        }
        Ok(())
    }

    /// Within a gap, replay goes on from here.
    fn memory(&mut self, logged: &[u8]) -> Result<(), String> {
        let Some(gap) = self.gap.take() else { return Ok(()) };
        let json = serde_json::from_slice::<MemoryJson<'_>>(logged).map_err(|e| one_line(&e))?;
        let resume = json.resume().ok_or_else(|| format!("the memory of tick {} is too long", json.tick))?;
        let Some(mut record) = self.last.take().filter(|last| last.tick == json.tick) else {
            self.gap = Some(gap);
            return Ok(());
        };
        record.resume = resume;
        let session = facts::read(&self.facts)?;
        let controller = self.load(record.snapshot, &session)?;
        let mut core = Core::new(session.core, controller, 0, session.faults.clone());
        core.resume(&record);
        self.running = Some((session, core));
        self.found.gaps.push(gap);
        Ok(())
    }

    /// Computes a tick and writes its message to `line`; false within a gap.
    fn advance(&mut self, given: &Given<'_>) -> Result<bool, String> {
        let lost = given.tick.saturating_sub(self.at + 1);
        if given.tick <= self.at {
            self.differ(
                given.tick,
                "tick",
                given.tick.to_string(),
                format!("{}: ticks only rise", self.at + 1),
            );
            return Ok(false);
        }
        if lost > 0 {
            self.running = None;
            let gap = self.gap.get_or_insert(Gap { from: self.at + 1, to: 0, lost: 0 });
            gap.lost += lost;
        }
        self.at = given.tick;
        if let Some(gap) = &mut self.gap {
            gap.to = given.tick;
            return Ok(false);
        }
        let (session, mut core) = match self.running.take() {
            Some(running) => running,
            None => self.start(given)?,
        };
        if given.swapped {
            core.controller = self.load(given.snapshot, &session)?;
            self.found.swaps += 1;
        }
        core.swap(given.swapped);
        let fresh = given.has_state.then_some(given.state);
        if let Some((field, has, of)) = fresh.and_then(|state| misfit(state, &session.robot)) {
            self.differ(given.tick, field, format!("{has} numbers"), format!("a robot of {of}"));
            return Ok(false);
        }
        let proposal = given.proposal;
        core.update(&Inputs { due: core.due(), begin: given.begin, stop: given.stop, fresh, proposal });
        core.close(given.end);
        // What only the loop's threads know: how long the projection took, and what found a ring full.
        let record = &mut core.record;
        record.output.ledger.duration = if record.output.nu > 0 { given.duration } else { 0 };
        (record.counters.dropped_actions, record.counters.dropped_records) = given.dropped;
        encode(record, &mut self.line).map_err(|e| e.to_string())?;
        self.running = Some((session, core));
        Ok(true)
    }

    fn start(&mut self, first: &Given<'_>) -> Result<(Session, Core<B::Controller>), String> {
        let session = facts::read(&self.facts)?;
        let controller = self.load(if first.swapped { 0 } else { first.snapshot }, &session)?;
        let core = Core::new(session.core, controller, first.due, session.faults.clone());
        Ok((session, core))
    }

    fn load(&mut self, id: u64, session: &Session) -> Result<Box<Loaded<B::Controller>>, String> {
        let missing = || format!("snapshot number {id} is not in it");
        let numbered = self.snapshots.get(&id).ok_or_else(missing)?;
        let bytes = self.attachments.get(&attachment_name(&numbered.digest)).ok_or_else(missing)?;
        if blake3::hash(bytes).to_hex().as_str() != numbered.digest {
            return Err(format!("snapshot number {id} is damaged"));
        }
        let mut header = SnapshotHeader::zeroed();
        (header.version, header.length) = (numbered.version, bytes.len() as u64);
        let snapshot = SnapshotBytes { header, bytes: bytes.clone() };
        let controller = self.build.build(&snapshot, &session.robot).map_err(|refusal| refusal.text)?;
        Ok(Box::new(Loaded { id, controller }))
    }

    fn compare(&mut self, tick: u64, logged: &[u8]) -> Result<(), String> {
        if logged != self.line {
            let log: Value = serde_json::from_slice(logged).map_err(|e| e.to_string())?;
            let own: Value = serde_json::from_slice(&self.line).map_err(|e| e.to_string())?;
            if let Some((field, log, own)) = first_difference("", &log, &own) {
                self.differ(tick, &field, log, own);
                return Ok(());
            }
        }
        self.found.ticks += 1;
        Ok(())
    }

    fn differ(&mut self, tick: u64, field: &str, log: String, replay: String) {
        self.found.difference = Some(Difference { tick, field: field.to_owned(), log, replay });
    }
}

/// What of a state has another length than the robot: its field, its length and the robot's.
fn misfit(state: &StateMessage, robot: &RobotMessage) -> Option<(&'static str, usize, usize)> {
    let lengths = [
        ("state.q", state.q(), robot.nq),
        ("state.v", state.v(), robot.nv),
        ("state.obs", state.obs(), robot.n_obs),
    ];
    let mut lengths = lengths.into_iter().map(|(field, values, of)| (field, values.len(), of as usize));
    lengths.find(|(_, has, of)| has != of)
}

/// Path and values of the first leaf that differs; numbers by their bits.
fn first_difference(path: &str, a: &Value, b: &Value) -> Option<(String, String, String)> {
    let join = |key: &str| if path.is_empty() { key.to_owned() } else { format!("{path}.{key}") };
    match (a, b) {
        (Value::Object(x), Value::Object(y)) => {
            let keys = x.keys().chain(y.keys().filter(|key| !x.contains_key(*key)));
            keys.filter_map(|key| {
                let value = |map: &serde_json::Map<String, Value>| map.get(key).cloned().unwrap_or_default();
                first_difference(&join(key), &value(x), &value(y))
            })
            .next()
        }
        (Value::Array(x), Value::Array(y)) if x.len() == y.len() => {
            let pairs = x.iter().zip(y).enumerate();
            pairs.filter_map(|(i, (x, y))| first_difference(&format!("{path}[{i}]"), x, y)).next()
        }
        (Value::Number(x), Value::Number(y)) => {
            let same = match (x.as_u64(), y.as_u64()) {
                (Some(x), Some(y)) => x == y,
                _ => x.as_f64().map(f64::to_bits) == y.as_f64().map(f64::to_bits),
            };
            (!same).then(|| (path.to_owned(), x.to_string(), y.to_string()))
        }
        _ => (a != b).then(|| (path.to_owned(), a.to_string(), b.to_string())),
    }
}
