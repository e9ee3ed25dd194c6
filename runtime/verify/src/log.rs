//! The file of a flight log (MCAP), read part by part: it may be larger than memory.

use std::collections::HashMap;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use mcap::read::parse_record;
use mcap::records::Record as Part;
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};

use crate::motion::UNKNOWN_ROBOT;
use crate::report::Report;
use crate::session::Session;
use crate::tick::{Brief, Numbered, Tick};

/// Bytes read at a time.
const PORTION: usize = 1 << 20;
/// Characters of another library's words in a message.
const WORDS: usize = 300;

/// Why a log cannot be verified.
#[derive(Debug, thiserror::Error)]
#[error("flight log '{file}' cannot be verified: {reason}{}", next(*is_log))]
pub struct VerifyError {
    file: PathBuf,
    reason: String,
    /// It is a log, of a robot that is not known here.
    is_log: bool,
}

fn next(is_log: bool) -> &'static str {
    if is_log { "" } else { "; give a file written by `nearl run --log` of this build" }
}

/// Verifies the log in `file`.
///
/// # Errors
/// [`VerifyError`] if it is no flight log of this build, is damaged, or holds a robot or a limit that is not known here; it says which.
pub fn verify(file: &Path) -> Result<Report, VerifyError> {
    let fail = |reason: String| {
        let plain: String = reason.replace(['\n', '\r'], " ").chars().take(WORDS).collect();
        let is_log = reason.contains(UNKNOWN_ROBOT);
        VerifyError { file: file.to_owned(), reason: plain, is_log }
    };
    let (log, length) = open(file).map_err(fail)?;
    let mut report = read(log, length).map_err(fail)?;
    report.intact = report.complete && ends_whole(file).map_err(|e| fail(e.to_string()))?;
    Ok(report)
}

/// Whether the file ends as MCAP ends, and there for the first time: with its footer, and the format's name behind it.
fn ends_whole(file: &Path) -> std::io::Result<bool> {
    /// Opcode and length of a part.
    const HEAD: u64 = 9;
    let mut log = BufReader::new(File::open(file)?);
    let length = log.get_ref().metadata()?.len();
    let (mut at, mut opcode) = (mcap::MAGIC.len() as u64, 0);
    while opcode != mcap::records::op::FOOTER {
        if at.saturating_add(HEAD) > length {
            return Ok(false);
        }
        let mut head = [0; HEAD as usize];
        log.seek(SeekFrom::Start(at))?;
        log.read_exact(&mut head)?;
        let [code, size @ ..] = head;
        opcode = code;
        at = at.saturating_add(HEAD).saturating_add(u64::from_le_bytes(size));
    }
    let mut end = [0; mcap::MAGIC.len()];
    if at.saturating_add(end.len() as u64) != length {
        return Ok(false);
    }
    log.seek(SeekFrom::Start(at))?;
    Ok(log.read_exact(&mut end).is_ok() && end == *mcap::MAGIC)
}

/// The log to be read from its start, and its length. A pipe, a device or a folder is refused without being opened.
fn open(file: &Path) -> Result<(BufReader<File>, usize), String> {
    let facts = std::fs::metadata(file).map_err(|e| e.to_string())?;
    if !facts.is_file() {
        return Err("it is not a regular file".into());
    }
    if facts.len() == 0 {
        return Err("it is empty".into());
    }
    let log = File::open(file).map_err(|e| e.to_string())?;
    Ok((BufReader::with_capacity(PORTION, log), usize::try_from(facts.len()).map_err(|e| e.to_string())?))
}

fn read(mut log: impl Read, length: usize) -> Result<Report, String> {
    // No part is longer than the file: a damaged length is refused before memory is taken for it.
    let options = LinearReaderOptions::default()
        .with_skip_end_magic(true)
        .with_validate_chunk_crcs(true)
        .with_record_length_limit(length);
    let mut reader = LinearReader::new_with_options(options);
    let (mut session, mut topics) = (Session::default(), HashMap::new());
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
            Ok(Part::DataEnd(_)) => session.report.complete = true,
            Ok(part) => take(&mut session, &mut topics, part)?,
            // A runtime that was killed leaves its last chunk unfinished.
            Err(mcap::McapError::UnexpectedEof | mcap::McapError::UnexpectedEoc) => break,
            // The reader is given bytes, and reads none itself.
            Err(mcap::McapError::Io(_) | mcap::McapError::DecompressionError(_)) => {
                return Err("a chunk of it is damaged, and cannot be unpacked".into());
            }
            Err(mcap::McapError::UnsupportedCompression(format)) => {
                return Err(format!(
                    "its chunks are compressed with {format}, which this program does not read: write it without compression, or with lz4"
                ));
            }
            Err(e) => return Err(e.to_string()),
        }
    }
    if session.report.ticks == 0 {
        return Err("it holds no ticks".into());
    }
    Ok(session.report)
}

fn take(session: &mut Session, topics: &mut HashMap<u16, String>, part: Part<'_>) -> Result<(), String> {
    match part {
        Part::Channel(channel) => {
            topics.insert(channel.id, channel.topic);
        }
        Part::Metadata(metadata) => session.fact(metadata.metadata),
        Part::Attachment { header, data, .. } => session.attach(&header.name, data.into_owned())?,
        Part::Message { header, data } => match topics.get(&header.channel_id).map(String::as_str) {
            Some("tick") => session.tick(&parse::<Tick>("tick", &data)?)?,
            Some("brief") => session.brief(parse::<Brief>("brief", &data)?.tick)?,
            Some("snapshot") => session.number(parse::<Numbered>("snapshot", &data)?),
            Some("memory") => {} // what a replay goes on from
            other => {
                return Err(format!("it has messages of topic {other:?}, which this build does not know"));
            }
        },
        _ => {}
    }
    Ok(())
}

fn parse<'a, T: serde::Deserialize<'a>>(topic: &str, data: &'a [u8]) -> Result<T, String> {
    serde_json::from_slice(data).map_err(|e| format!("a message of topic `{topic}` is damaged: {e}"))
}
