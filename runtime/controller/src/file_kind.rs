//! Tells by its first bytes what a file is that is no snapshot, so that the refusal can name it.

/// Kinds of files that hold policies, or are mistaken for one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FileKind {
    /// ONNX.
    Onnx,
    /// A zip archive: PyTorch, TorchScript, Stable-Baselines3.
    Zip,
    /// A Python pickle.
    Pickle,
    /// HDF5, as Keras writes it.
    Hdf5,
    /// safetensors.
    Safetensors,
    /// TensorFlow Lite.
    TfLite,
    /// A robot file in XML.
    Xml,
}

impl FileKind {
    /// The kind of a file with these first bytes; `None` for any other.
    pub fn of(bytes: &[u8]) -> Option<Self> {
        let text = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes).trim_ascii_start();
        match bytes {
            [b'P', b'K', 3, 4, ..] => Some(Self::Zip),
            [0x80, 2..=5, ..] => Some(Self::Pickle),
            [0x89, b'H', b'D', b'F', ..] => Some(Self::Hdf5),
            [_, _, _, _, b'T', b'F', b'L', b'3', ..] => Some(Self::TfLite),
            [_, _, _, _, _, 0, 0, 0, b'{', ..] => Some(Self::Safetensors),
            // field 1, the version of the format, then a field of the model
            [8, 1..=31, 0x12 | 0x1a | 0x22 | 0x28 | 0x32 | 0x3a | 0x42, ..] => Some(Self::Onnx),
            _ if text.starts_with(b"<") => Some(Self::Xml),
            _ => None,
        }
    }

    /// Its name with an article.
    pub fn name(self) -> &'static str {
        match self {
            Self::Onnx => "an ONNX model",
            Self::Zip => "a zip archive, as PyTorch and Stable-Baselines3 write them",
            Self::Pickle => "a Python pickle, which is never opened",
            Self::Hdf5 => "an HDF5 file",
            Self::Safetensors => "a safetensors file",
            Self::TfLite => "a TensorFlow Lite model",
            Self::Xml => "an XML file, as robots are described in",
        }
    }

    /// What to do with it.
    pub fn next(self) -> &'static str {
        match self {
            Self::Onnx => "make a snapshot of it: nearl import POLICY.onnx --robot FILE --out SNAPSHOT",
            Self::Zip => {
                "load it with the library that wrote it and give the object to nearl.import_sb3 or nearl.import_torch, or export ONNX"
            }
            Self::Pickle | Self::Hdf5 | Self::TfLite => "export ONNX with the library that wrote it",
            Self::Safetensors => "give it to 'nearl run' if 'nearl train' or 'nearl import' wrote it",
            Self::Xml => "give it with --robot",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kinds_are_told_by_their_first_bytes() {
        let kinds: [(&[u8], Option<FileKind>); 8] = [
            (b"PK\x03\x04....", Some(FileKind::Zip)),
            (b"\x80\x04\x95...", Some(FileKind::Pickle)),
            (b"\x89HDF\r\n", Some(FileKind::Hdf5)),
            (b"\x1c\0\0\0TFL3", Some(FileKind::TfLite)),
            (b"\x10\0\0\0\0\0\0\0{\"a\"", Some(FileKind::Safetensors)),
            (b"\x08\x08\x12\x07pytorch", Some(FileKind::Onnx)),
            (b"\n<?xml version", Some(FileKind::Xml)),
            (b"", None),
        ];
        for (bytes, kind) in kinds {
            assert_eq!(FileKind::of(bytes), kind, "{bytes:?}");
        }
    }
}
