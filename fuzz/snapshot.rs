//! Damaged snapshots: whole files, and files whose digest fits the damage so that it gets further.

use nearl_runtime::snapshot::digest;
use nearl_runtime::{Controller, Snapshot};
use serde_json::{Map, Value};

use crate::assert_sentence;
use crate::mutate::{Rng, mutate};

pub fn damage(rng: &mut Rng, base: &[u8], other: &[u8]) -> Vec<u8> {
    match rng.below(4) {
        0 => mutate(rng, base, other),
        1 => signed(rng, base, true).unwrap_or_else(|| base.to_vec()),
        _ => signed(rng, base, false).unwrap_or_else(|| base.to_vec()),
    }
}

/// The file in `base` with a damaged manifest, or damaged tensors, and the digest of what it now holds.
fn signed(rng: &mut Rng, base: &[u8], tensors: bool) -> Option<Vec<u8>> {
    let length = u64::from_le_bytes(base.get(..8)?.try_into().ok()?) as usize;
    let mut header: Map<String, Value> = serde_json::from_slice(base.get(8..8 + length)?).ok()?;
    let mut data = base[8 + length..].to_vec();
    let key = header.get("__metadata__")?.as_object()?.keys().next()?.clone();
    let old = header["__metadata__"][&key].as_str()?.to_owned();
    let mut manifest = old.split_once('\n')?.1.to_owned();
    if tensors {
        let wild = [f32::NAN, f32::INFINITY, f32::MAX, 0.0, -1.0, f32::from_bits(1)];
        for _ in 0..=rng.below(4) {
            let at = rng.below(data.len() / 4) * 4;
            let number = *rng.pick(&wild);
            data[at..at + 4].copy_from_slice(&number.to_le_bytes());
        }
    } else {
        let damaged = mutate(rng, manifest.as_bytes(), old.as_bytes());
        manifest = String::from_utf8_lossy(&damaged).into_owned();
    }
    let entries = header.iter().filter(|(name, _)| *name != "__metadata__");
    let parts: Vec<(String, Vec<usize>, Vec<u8>)> = entries
        .map(|(name, entry)| {
            let numbers = |key: &str| -> Vec<usize> {
                entry[key]
                    .as_array()
                    .into_iter()
                    .flatten()
                    .filter_map(Value::as_u64)
                    .map(|n| n as usize)
                    .collect()
            };
            let place = numbers("data_offsets");
            Some((name.clone(), numbers("shape"), data.get(*place.first()?..*place.get(1)?)?.to_vec()))
        })
        .collect::<Option<_>>()?;
    let sum = digest(&manifest, parts.iter().map(|(n, s, d)| (n.as_str(), s.as_slice(), d.as_slice())));
    header.insert("__metadata__".into(), serde_json::json!({ key: format!("{sum}\n{manifest}") }));
    let header = serde_json::to_vec(&header).ok()?;
    Some([&(header.len() as u64).to_le_bytes()[..], &header, &data].concat())
}

pub fn read(bytes: &[u8]) {
    let words = ["snapshot", "tensor", "task", "canary"];
    match Snapshot::from_bytes(bytes).and_then(|s| Controller::new(&s)) {
        Err(error) => assert_sentence(&error.to_string(), &words),
        Ok(mut controller) => {
            let (state, noise, mut out) = (controller.state(), controller.noise(), controller.output());
            controller.update(&state, &noise, &mut out);
            assert!(out.action.iter().all(|a| a.is_finite()), "{:?}", out.action);
        }
    }
}
