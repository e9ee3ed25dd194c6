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
fn within(rng: &mut Rng, base: &[u8]) -> Option<Vec<u8>> {
    let victim = rng.below(24);
    let mut writer = mcap::WriteOptions::new().compression(None).create(Cursor::new(Vec::new())).ok()?;
    let mut channels: BTreeMap<u16, u16> = BTreeMap::new();
    for (n, part) in ChunkFlattener::new(base).ok()?.enumerate() {
        let hit = n == victim || (n > 6 && rng.below(12) == 0);
        match part.ok()? {
            Record::DataEnd(_) => break,
            Record::Metadata(mut m) => {
                if hit {
                    for value in m.metadata.values_mut() {
                        *value = String::from_utf8_lossy(&mutate(rng, value.as_bytes(), b"{}")).into_owned();
                    }
                }
                writer.write_metadata(&m).ok()?;
            }
            Record::Attachment { header, data, .. } => {
                let data = if hit { mutate(rng, &data, base) } else { data.into_owned() };
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
                let data = if hit { mutate(rng, &data, b"[1e308, null]") } else { data.into_owned() };
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
