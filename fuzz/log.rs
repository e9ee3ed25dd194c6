//! Damaged flight logs: whole files, and messages damaged inside a file that is otherwise sound.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::Path;

use mcap::read::ChunkFlattener;
use mcap::records::{MessageHeader, Record};
use nearl_runtime::log::replay;

use crate::assert_sentence;
use crate::mutate::{Rng, mutate};

pub fn damage(rng: &mut Rng, base: &[u8], other: &[u8]) -> Vec<u8> {
    match rng.below(3) {
        0 => mutate(rng, base, other),
        _ => within(rng, base).unwrap_or_else(|| base.to_vec()),
    }
}

/// Writes the log again with one of its parts damaged.
pub fn within(rng: &mut Rng, base: &[u8]) -> Option<Vec<u8>> {
    let victim = rng.below(24);
    again(base, &mut |n, part, data| {
        let other: &[u8] = match part {
            Part::Fact => b"{}",
            Part::Snapshot => base,
            Part::Message => b"[1e308, null]",
        };
        let is_hit = n == victim || (n > 6 && rng.below(12) == 0);
        if is_hit { mutate(rng, data, other) } else { data.to_vec() }
    })
}

/// What bytes of a log are.
pub enum Part {
    /// A value of the metadata.
    Fact,
    Snapshot,
    Message,
}

/// What becomes of the bytes of a part, by the part's place.
pub type Change<'a> = &'a mut dyn FnMut(usize, Part, &[u8]) -> Vec<u8>;

/// Writes the log again with its parts changed, as a file that is sound.
pub fn again(base: &[u8], change: Change<'_>) -> Option<Vec<u8>> {
    let mut writer = mcap::WriteOptions::new().compression(None).create(Cursor::new(Vec::new())).ok()?;
    let mut channels: BTreeMap<u16, u16> = BTreeMap::new();
    for (n, part) in ChunkFlattener::new(base).ok()?.enumerate() {
        match part.ok()? {
            Record::DataEnd(_) => break,
            Record::Metadata(mut m) => {
                for value in m.metadata.values_mut() {
                    *value = String::from_utf8_lossy(&change(n, Part::Fact, value.as_bytes())).into_owned();
                }
                writer.write_metadata(&m).ok()?;
            }
            Record::Attachment { header, data, .. } => {
                let data = change(n, Part::Snapshot, &data);
                let (name, media_type) = (header.name, header.media_type);
                let attachment = mcap::Attachment {
                    log_time: 0,
                    create_time: 0,
                    name,
                    media_type,
                    data: Cow::Owned(data),
                };
                writer.attach(&attachment).ok()?;
            }
            Record::Channel(c) => {
                let schema = writer.add_schema(&c.topic, "jsonschema", b"{}").ok()?;
                channels.insert(c.id, writer.add_channel(schema, &c.topic, "json", &BTreeMap::new()).ok()?);
            }
            Record::Message { header, data } => {
                let data = change(n, Part::Message, &data);
                let header = MessageHeader { channel_id: *channels.get(&header.channel_id)?, ..header };
                writer.write_to_known_channel(&header, &data).ok()?;
            }
            _ => {}
        }
    }
    writer.finish().ok()?;
    Some(writer.into_inner().into_inner())
}

pub fn read(file: &Path, bytes: &[u8]) {
    std::fs::write(file, bytes).expect("log");
    match replay(file) {
        Err(error) => assert_sentence(&error.to_string(), &["flight.mcap"]),
        Ok(found) => {
            if let Some(difference) = found.difference {
                assert_sentence(&difference.to_string(), &["tick"]);
            }
        }
    }
}
