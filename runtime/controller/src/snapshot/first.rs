//! Reads the manifest of a snapshot, of today's format or of format 1. A snapshot of format 1 carried the robot as the text of its
//! file in place of numbers.

use super::{FORMAT, FORMAT_WITH_SKIP, Manifest, ModelFormat};
use nearl_constraints::Model;
use serde_json::{Map, Value};

/// Reads a manifest; one of format 1 with a URDF becomes one of today's.
///
/// # Errors
/// A sentence.
pub(super) fn read(text: &str) -> Result<Manifest, String> {
    let words = |e: serde_json::Error| e.to_string();
    #[derive(serde::Deserialize)]
    struct Version {
        format: u32,
    }
    let version: Version = serde_json::from_str(text).map_err(words)?;
    let of_today = match version.format {
        FORMAT | FORMAT_WITH_SKIP => None,
        1 => Some(translate(serde_json::from_str(text).map_err(words)?)?),
        other => return Err(format!("format {other} where this program reads 1 to {FORMAT_WITH_SKIP}")),
    };
    let read: Manifest = serde_json::from_str(of_today.as_deref().unwrap_or(text)).map_err(words)?;
    Ok(Manifest { format: FORMAT, ..read })
}

/// The text of today's manifest for one of format 1.
fn translate(mut old: Map<String, Value>) -> Result<String, String> {
    let mut take = |key: &str| old.remove(key).ok_or_else(|| format!("format 1 without '{key}'"));
    let (format, text) = (take("model_format")?, take("model")?);
    let format: ModelFormat = serde_json::from_value(format).map_err(|e| e.to_string())?;
    let text = text.as_str().ok_or("format 1 with a robot that is no text")?;
    let floats = old.get("task").is_some_and(|task| task["model"]["free_flyer"] == true);
    let model = match format {
        ModelFormat::Urdf if floats => Model::from_urdf_text_free_flyer(text),
        ModelFormat::Urdf => Model::from_urdf_text(text),
        ModelFormat::Mjcf => {
            return Err("format 1 with an MJCF robot, which only MuJoCo reads; train again, or keep the version that wrote it".into());
        }
    };
    let model = model.map_err(|e| e.to_string())?;
    old.insert("format".into(), FORMAT.into());
    old.insert("robot".into(), serde_json::to_value(model.description()).map_err(|e| e.to_string())?);
    Ok(Value::Object(old).to_string())
}
