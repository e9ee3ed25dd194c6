//! Whether the lengths in an ONNX file fit each other. The reader makes room for what a length says before it looks whether so much is
//! there, so a damaged file could ask for more memory than there is.

/// A message of ONNX: the messages inside it by field number, and fields that a policy's file does not have.
struct Message(&'static [(u64, &'static Message)], &'static [u64]);

const LEAF: Message = Message(&[], &[]);
const DIMENSION: Message = Message(&[], &[]);
const SHAPE: Message = Message(&[(1, &DIMENSION)], &[]);
const TENSOR_TYPE: Message = Message(&[(2, &SHAPE)], &[]);
const TYPE: Message = Message(&[(1, &TENSOR_TYPE)], &[4, 5, 8, 9]);
const VALUE: Message = Message(&[(2, &TYPE)], &[]);
const TENSOR: Message = Message(&[(13, &LEAF)], &[]);
const ATTRIBUTE: Message = Message(&[(5, &TENSOR)], &[6, 11]);
const NODE: Message = Message(&[(5, &ATTRIBUTE)], &[]);
const GRAPH: Message = Message(&[(1, &NODE), (5, &TENSOR), (11, &VALUE), (12, &VALUE), (13, &VALUE)], &[]);
const MODEL: Message = Message(&[(7, &GRAPH), (8, &LEAF), (14, &LEAF)], &[]);

/// Whether the bytes are a model whose every length ends within what holds it. Graphs inside a node (loops, branches) are none of a policy's
/// and are not looked into; a file with one is refused.
pub(super) fn is_sound(bytes: &[u8]) -> bool {
    check(bytes, &MODEL).is_some()
}

fn check(mut bytes: &[u8], message: &Message) -> Option<()> {
    while !bytes.is_empty() {
        let tag = varint(&mut bytes)?;
        let (field, wire) = (tag >> 3, tag & 7);
        match wire {
            0 => drop(varint(&mut bytes)?),
            1 => drop(take(&mut bytes, 8)?),
            5 => drop(take(&mut bytes, 4)?),
            2 => {
                let length = usize::try_from(varint(&mut bytes)?).ok()?;
                let inner = take(&mut bytes, length)?;
                if message.1.contains(&field) {
                    return None;
                }
                if let Some((_, kind)) = message.0.iter().find(|(number, _)| *number == field) {
                    check(inner, kind)?;
                }
            }
            _ => return None,
        }
    }
    Some(())
}

fn take<'a>(bytes: &mut &'a [u8], n: usize) -> Option<&'a [u8]> {
    let (first, rest) = bytes.split_at_checked(n)?;
    *bytes = rest;
    Some(first)
}

fn varint(bytes: &mut &[u8]) -> Option<u64> {
    let mut value = 0;
    for k in 0..10 {
        let byte = take(bytes, 1)?[0];
        value |= u64::from(byte & 0x7f).checked_shl(7 * k)?;
        if byte < 0x80 {
            return Some(value);
        }
    }
    None
}
