//! Reads a snapshot, of this format or an earlier one, and writes it in today's: `rewrite_snapshot OLD.safetensors NEW.safetensors`.

use std::path::PathBuf;

use nearl_controller::Snapshot;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let files: Vec<PathBuf> = std::env::args_os().skip(1).map(PathBuf::from).collect();
    let [old, new] = &files[..] else {
        return Err("give two files: the old snapshot and the new one".into());
    };
    Ok(Snapshot::load(old)?.save(new)?)
}
