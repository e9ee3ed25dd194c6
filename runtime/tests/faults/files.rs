//! Faults of snapshot files.

use std::time::{Duration, Instant};

use nearl_constraints::Model;
use nearl_runtime::{Snapshot, SnapshotError};

use crate::arm::*;

/// A small snapshot: the robot file makes most of it.
fn bytes() -> Vec<u8> {
    snapshot(1, |_| {}).to_bytes()
}

#[test]
fn fault_10_every_flipped_byte_is_refused() {
    let good = bytes();
    assert!(Snapshot::from_bytes(&good).is_ok());
    let mut damaged = good.clone();
    // A prime step, so that every kind of byte (header, manifest, weights) is met; all of them take a minute.
    for at in (0..good.len()).step_by(13) {
        damaged[at] ^= 1 << (at % 8);
        let error = Snapshot::from_bytes(&damaged).err();
        assert!(error.is_some(), "byte {at} of {} was flipped and not missed", good.len());
        damaged[at] = good[at];
    }
    let last = good.len() - 1;
    damaged[last] ^= 1;
    assert_eq!(Snapshot::from_bytes(&damaged).unwrap_err().code(), "snapshot-digest");
}

#[test]
fn fault_12_every_truncation_is_refused() {
    let good = bytes();
    for length in 0..good.len() {
        let error = Snapshot::from_bytes(&good[..length]).unwrap_err();
        assert_eq!(error.code(), "snapshot-malformed", "{length} of {} bytes", good.len());
    }
    assert!(Snapshot::from_bytes(&good).is_ok(), "the next good one is taken");
}

#[test]
fn fault_13_what_is_no_regular_file_is_refused_at_once() {
    let folder = Scratch::new("fault13");
    let (fifo, link, file) = (folder.0.join("fifo"), folder.0.join("link"), folder.0.join("file"));
    std::fs::write(&file, bytes()).unwrap();
    std::os::unix::fs::symlink(&file, &link).unwrap();
    let name = std::ffi::CString::new(fifo.to_str().unwrap()).unwrap();
    // SAFETY: plain call with a path that ends in a zero.
    assert_eq!(unsafe { libc::mkfifo(name.as_ptr(), 0o600) }, 0);
    let begin = Instant::now();
    for path in [&fifo, &link, &folder.0, &"/dev/zero".into(), &folder.0.join("missing")] {
        let error: SnapshotError = Snapshot::load(path).unwrap_err();
        assert_eq!(error.code(), "snapshot-unreadable", "{}", path.display());
    }
    assert!(begin.elapsed() < Duration::from_secs(30), "a pipe without a writer was opened");
    std::fs::set_permissions(&file, std::os::unix::fs::PermissionsExt::from_mode(0o000)).unwrap();
    // Root may read everything: a thread of its own gives up being root, for files alone.
    let unreadable = std::thread::spawn(move || {
        // SAFETY: plain calls; they change this thread only.
        unsafe {
            libc::setfsgid(65534);
            libc::setfsuid(65534);
        }
        Snapshot::load(&file).unwrap_err()
    });
    let error = unreadable.join().unwrap();
    assert_eq!(error.code(), "snapshot-unreadable");
    assert!(error.to_string().contains("Permission denied"), "{error}");
}

/// Text of the robot file with the limits of some joints changed.
fn robot_with(joints: &[usize], limit: &str) -> String {
    let mut text = URDF.to_owned();
    for &i in joints {
        let from = text.find(&format!("<joint name=\"{}\"", joint(i))).unwrap();
        let at = from + text[from..].find("<limit").unwrap();
        let end = at + text[at..].find("/>").unwrap() + 2;
        text.replace_range(at..end, limit);
    }
    text
}

#[test]
fn fault_27_missing_and_odd_limits_are_refused_by_joint() {
    let cases = [
        (r#"<limit effort="0" velocity="0"/>"#, "lower and upper"),
        (r#"<limit lower="-1" upper="1" effort="87" velocity="0"/>"#, "velocity"),
        (r#"<limit lower="-1" upper="1" effort="0" velocity="2"/>"#, "effort"),
        (r#"<limit lower="1" upper="-1" effort="87" velocity="2"/>"#, "lower 1 above upper -1"),
        (r#"<limit lower="nan" upper="1" effort="87" velocity="2"/>"#, "lower is 'nan'"),
        (r#"<limit lower="-1" upper="1" effort="87" velocity="fast"/>"#, "velocity is 'fast'"),
        (r#"<limit lower="-1" upper="1" effort="-87" velocity="2"/>"#, "effort is '-87'"),
    ];
    for (limit, says) in cases {
        // What cannot be is refused where the file is read, what is missing where the constraints ask for it.
        let text = match Model::from_urdf_text(&robot_with(&[1, 4], limit)) {
            Err(error) => error.to_string(),
            Ok(model) => {
                let foreign = snapshot(1, |m| m.robot = model.description().clone());
                let error = nearl_runtime::Controller::new(&foreign).err().unwrap();
                assert_eq!(error.code(), "snapshot-unusable", "{error}");
                error.to_string()
            }
        };
        for word in [says, "'panda_joint2'", "'panda_joint5'"] {
            assert!(text.contains(word), "'{word}' is not in: {text}");
        }
    }
}
