//! Faults of snapshot files.

use std::time::{Duration, Instant};

use nearl_constraints::Model;
use nearl_runtime::snapshot::digest;
use nearl_runtime::{Snapshot, SnapshotError};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};

use crate::arm::*;

/// A small snapshot: the robot makes most of it.
fn bytes() -> Vec<u8> {
    snapshot(1, |_| {}).to_bytes()
}

#[test]
fn fault_10_every_flipped_byte_is_refused() {
    let good = bytes();
    assert!(Snapshot::from_bytes(&good).is_ok());
    let mut damaged = good.clone();
    // Every byte, and a bit of it: header, manifest and weights.
    for at in 0..good.len() {
        damaged[at] ^= 1 << (at % 8);
        let error = Snapshot::from_bytes(&damaged).err();
        assert!(error.is_some(), "byte {at} of {} was flipped and not missed", good.len());
        damaged[at] = good[at];
    }
    let last = good.len() - 1;
    damaged[last] ^= 1;
    assert_eq!(Snapshot::from_bytes(&damaged).unwrap_err().code(), "snapshot-digest");
}

/// A tensor as it lies in a file: name, type, shape, bytes.
type Tensor = (String, Dtype, Vec<usize>, Vec<u8>);

/// The file of `good` with other tensors, or another manifest, and a digest that is right for them.
fn rewritten(good: &[u8], change: impl FnOnce(&mut Vec<Tensor>, &mut String)) -> Vec<u8> {
    let file = SafeTensors::deserialize(good).unwrap();
    let (_, header) = SafeTensors::read_metadata(good).unwrap();
    let text = header.metadata().as_ref().unwrap()["nearl"].clone();
    let mut manifest = text.split_once('\n').unwrap().1.to_owned();
    let mut tensors: Vec<Tensor> = file
        .tensors()
        .into_iter()
        .map(|(n, v)| (n, v.dtype(), v.shape().to_vec(), v.data().to_vec()))
        .collect();
    change(&mut tensors, &mut manifest);
    let parsed = tensors.iter().map(|(n, _, shape, data)| (n.as_str(), shape.as_slice(), data.as_slice()));
    let header = format!("{}\n{manifest}", digest(&manifest, parsed));
    let views = tensors
        .iter()
        .map(|(n, dtype, shape, data)| (n.clone(), TensorView::new(*dtype, shape.clone(), data).unwrap()));
    safetensors::serialize(views, Some([("nearl".to_owned(), header)].into())).unwrap()
}

fn code(bytes: &[u8]) -> (&'static str, String) {
    let error =
        Snapshot::from_bytes(bytes).and_then(|s| nearl_runtime::Controller::new(&s).map(|_| ())).unwrap_err();
    (error.code(), error.to_string())
}

/// Every tensor in turn is missing, renamed, of another type, of another shape; every file whole and with its right digest.
#[test]
fn fault_09_every_tensor_that_is_missing_or_of_another_type_or_shape_is_refused_by_name() {
    let good = bytes();
    assert_eq!(rewritten(&good, |_, _| {}).len(), good.len(), "the digest is made as the file's own is");
    assert!(Snapshot::from_bytes(&rewritten(&good, |_, _| {})).is_ok());
    let names: Vec<String> =
        SafeTensors::deserialize(&good).unwrap().names().into_iter().map(str::to_owned).collect();
    assert!(names.len() > 6, "{names:?}");
    for name in &names {
        let place = |tensors: &[Tensor]| tensors.iter().position(|t| t.0 == *name).unwrap();
        let missing = rewritten(&good, |tensors, _| drop(tensors.remove(place(tensors))));
        let renamed = rewritten(&good, |tensors, _| {
            let at = place(tensors);
            tensors[at].0.push('x');
        });
        for file in [missing, renamed] {
            let (code, text) = code(&file);
            // A layer that is gone leaves a network of another shape, a layer by another name one that nobody reads.
            let unread = code == "snapshot-foreign" && text.contains(&format!("'{name}x'"));
            assert!(
                unread || ["snapshot-missing-tensor", "snapshot-shape"].contains(&code),
                "{name}: {text}"
            );
        }
        let typed = rewritten(&good, |tensors, _| {
            let at = place(tensors);
            let tensor = &mut tensors[at];
            tensor.1 = if tensor.1 == Dtype::F32 { Dtype::I32 } else { Dtype::I64 };
        });
        let longer = rewritten(&good, |tensors, _| {
            let at = place(tensors);
            let width = if tensors[at].1 == Dtype::F32 { 4 } else { 8 };
            let tensor = &mut tensors[at];
            tensor.2[0] += 1;
            let row: usize = tensor.2[1..].iter().product();
            let one = if width == 4 { 1_f32.to_le_bytes().to_vec() } else { 1_f64.to_le_bytes().to_vec() };
            tensor.3.extend(one.repeat(row));
        });
        for file in [typed, longer] {
            let (code, text) = code(&file);
            assert_eq!(code, "snapshot-shape", "{name}: {text}");
            let network = name.split('.').next().unwrap();
            assert!(text.contains(network), "'{network}' is not in: {text}");
        }
    }
}

#[test]
fn a_tensor_that_no_snapshot_has_is_refused_by_name() {
    let good = bytes();
    for name in ["policy.gate", "policy.0.scale", "critic.0.weight"] {
        let file = rewritten(&good, |tensors, _| {
            tensors.push((name.into(), Dtype::F32, vec![1], 1_f32.to_le_bytes().to_vec()));
        });
        let (code, text) = code(&file);
        assert_eq!(code, "snapshot-foreign", "{name}: {text}");
        assert!(text.contains(&format!("a tensor '{name}'")), "{text}");
    }
}

#[test]
fn fault_11_every_number_that_is_none_or_far_too_large_is_refused_with_its_place() {
    let good = bytes();
    let names: Vec<String> =
        SafeTensors::deserialize(&good).unwrap().names().into_iter().map(str::to_owned).collect();
    for name in names.iter().filter(|name| !name.ends_with("log_std")) {
        for value in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 3e38, -1e30] {
            let bad = rewritten(&good, |tensors, _| {
                let tensor = tensors.iter_mut().find(|t| t.0 == *name).unwrap();
                match tensor.1 {
                    Dtype::F32 => tensor.3[4..8].copy_from_slice(&(value as f32).to_le_bytes()),
                    _ => tensor.3[8..16].copy_from_slice(&value.to_le_bytes()),
                }
            });
            let (code, text) = code(&bad);
            assert_eq!(code, "snapshot-value", "{name} = {value}: {text}");
            assert!(text.contains(name.as_str()) && text.contains("index 1"), "{text}");
        }
    }
    for name in ["normaliser.std", "normaliser.scale"] {
        for value in [0.0_f64, -0.0, -1.0] {
            let bad = rewritten(&good, |tensors, _| {
                let tensor = tensors.iter_mut().find(|t| t.0 == name).unwrap();
                tensor.3[8..16].copy_from_slice(&value.to_le_bytes());
            });
            assert_eq!(code(&bad).0, "snapshot-value", "{name} = {value}");
        }
    }
}

/// A manifest that is nested without end, and numbers without end, behind a digest that is right.
#[test]
fn fault_39_a_manifest_nested_beyond_measure_is_refused_and_overflows_no_stack() {
    let good = bytes();
    for (open, close) in [("[", "]"), ("{\"a\":", "}")] {
        let deep = format!("{}1{}", open.repeat(200_000), close.repeat(200_000));
        let bad = rewritten(&good, |_, manifest| {
            *manifest = manifest.replacen("\"train\":{", &format!("\"train\":{{\"deep\":{deep},"), 1);
            assert!(manifest.len() > 400_000);
        });
        let (code, text) = code(&bad);
        assert_eq!(code, "snapshot-foreign", "{text}");
        assert!(text.contains("recursion limit"), "{text}");
    }
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
