//! NumPy's `.npz`: a zip archive of `.npy` arrays, stored without compression as `numpy.savez` writes it.

use std::collections::BTreeMap;

/// One array.
#[derive(Clone, Debug, PartialEq)]
pub struct Array {
    /// Sizes, outermost first; empty for a single number.
    pub shape: Vec<usize>,
    /// Entries.
    pub values: Values,
}

/// Entries of an array in C order.
#[derive(Clone, Debug, PartialEq)]
pub enum Values {
    /// Numbers, whatever their width in the file.
    Numbers(Vec<f64>),
    /// Whole numbers, to be written as such; they are read as numbers.
    Whole(Vec<i64>),
    /// Words.
    Words(Vec<String>),
}

const LOCAL: u32 = 0x0403_4b50;
const CENTRAL: u32 = 0x0201_4b50;
const END: u32 = 0x0605_4b50;
/// Sizes that stand in an extra field instead (zip64), which NumPy writes for every array.
const ELSEWHERE: u64 = 0xffff_ffff;

fn number(bytes: &[u8], at: usize, width: usize) -> Result<u64, String> {
    let part = bytes.get(at..at + width).ok_or("it is cut short")?;
    Ok(part.iter().rev().fold(0, |n, b| n << 8 | u64::from(*b)))
}

/// Every array of the file by its name.
///
/// # Errors
/// One sentence; nothing of a damaged file is returned.
pub fn read(bytes: &[u8]) -> Result<BTreeMap<String, Array>, String> {
    let last = bytes.len().checked_sub(22).ok_or("it is no zip archive, or cut short")?;
    let found =
        (last.saturating_sub(65_535)..=last).rev().find(|&at| number(bytes, at, 4) == Ok(u64::from(END)));
    let end = found.ok_or("it is no zip archive, or cut short")?;
    let (count, mut at) = (number(bytes, end + 10, 2)?, number(bytes, end + 16, 4)? as usize);
    let mut arrays = BTreeMap::new();
    for _ in 0..count {
        if number(bytes, at, 4)? != u64::from(CENTRAL) {
            return Err("its list of arrays is damaged".into());
        }
        let field = |offset, width| number(bytes, at + offset, width);
        let (name_len, extra_len, comment_len) = (field(28, 2)?, field(30, 2)?, field(32, 2)?);
        let start = at + 46;
        let name = bytes.get(start..start + name_len as usize).ok_or("it is cut short")?;
        let name = String::from_utf8_lossy(name).into_owned();
        if field(10, 2)? != 0 {
            return Err(format!("array '{name}' is compressed; write the file with numpy.savez"));
        }
        let (packed, place) = (field(20, 4)?, field(42, 4)?);
        if packed == ELSEWHERE || place == ELSEWHERE {
            return Err(format!("array '{name}' lies beyond 4 GB; split the file"));
        }
        let place = place as usize;
        if number(bytes, place, 4)? != u64::from(LOCAL) {
            return Err(format!("array '{name}' is not where the list says"));
        }
        let data =
            place + 30 + number(bytes, place + 26, 2)? as usize + number(bytes, place + 28, 2)? as usize;
        let content = bytes.get(data..data + packed as usize).ok_or("it is cut short")?;
        if u64::from(crc32fast::hash(content)) != field(16, 4)? {
            return Err(format!("array '{name}' is damaged: its checksum differs"));
        }
        let key = name.trim_end_matches(".npy").to_string();
        arrays.insert(key, array(content).map_err(|e| format!("array '{name}': {e}"))?);
        at = start + (name_len + extra_len + comment_len) as usize;
    }
    Ok(arrays)
}

/// What follows `'key':` in the header of an array.
fn entry<'a>(header: &'a str, key: &str) -> Result<&'a str, String> {
    let (_, rest) = header.split_once(&format!("'{key}':")).ok_or(format!("its header has no '{key}'"))?;
    Ok(rest.trim_start())
}

fn array(bytes: &[u8]) -> Result<Array, String> {
    if !bytes.starts_with(b"\x93NUMPY") {
        return Err("it is no .npy array".into());
    }
    let wide = number(bytes, 6, 1)? >= 2;
    let (start, len) = if wide { (12, number(bytes, 8, 4)?) } else { (10, number(bytes, 8, 2)?) };
    let data = start + len as usize;
    let header = String::from_utf8_lossy(bytes.get(start..data).ok_or("it is cut short")?).into_owned();
    if entry(&header, "fortran_order")?.starts_with("True") {
        return Err("it is in Fortran order; write numpy.ascontiguousarray of it".into());
    }
    let kind = entry(&header, "descr")?.strip_prefix('\'').and_then(|rest| rest.split('\'').next());
    let kind = kind.ok_or("its entries are of several parts; give numbers or text")?;
    let shape = entry(&header, "shape")?.trim_start_matches('(').split(')').next().unwrap_or_default();
    let sizes = shape.split(',').map(str::trim).filter(|s| !s.is_empty()).map(str::parse::<usize>);
    let shape = sizes.collect::<Result<Vec<_>, _>>().map_err(|e| format!("its shape cannot be read: {e}"))?;
    let n = shape.iter().try_fold(1usize, |n, size| n.checked_mul(*size));
    let n = n.ok_or_else(|| format!("its shape {shape:?} has more entries than a file can hold"))?;
    let width = match kind.as_bytes() {
        [_, b'U', digits @ ..] => {
            let letters = std::str::from_utf8(digits).ok().and_then(|d| d.parse::<usize>().ok());
            letters.and_then(|letters| letters.checked_mul(4))
        }
        [_, _, digit @ b'1'..=b'8'] => Some(usize::from(digit - b'0')),
        _ => None,
    };
    let unread = || format!("entries of type '{kind}' are not read; give little-endian numbers or text");
    let width = width.filter(|width| *width > 0).ok_or_else(unread)?;
    let content = bytes.get(data..).unwrap_or_default();
    if Some(content.len()) != n.checked_mul(width) {
        return Err(format!("it has {} bytes where {n} entries of type '{kind}' are told", content.len()));
    }
    let parts = content.chunks_exact(width);
    let integer = |b: &[u8]| b.iter().rev().fold(0u64, |n, b| n << 8 | u64::from(*b));
    let signed = |b: &[u8]| (integer(b) << (64 - 8 * b.len()) as u32) as i64 >> (64 - 8 * b.len()) as u32;
    let values = match (kind.as_bytes()[0], kind.as_bytes()[1], width) {
        (b'<', b'f', 8) => Values::Numbers(parts.map(|b| f64::from_bits(integer(b))).collect()),
        (b'<', b'f', 4) => {
            Values::Numbers(parts.map(|b| f64::from(f32::from_bits(integer(b) as u32))).collect())
        }
        (b'<' | b'|', b'i', _) => Values::Numbers(parts.map(|b| signed(b) as f64).collect()),
        (b'<' | b'|', b'u' | b'b', _) => Values::Numbers(parts.map(|b| integer(b) as f64).collect()),
        (b'<', b'U', _) => Values::Words(parts.map(word).collect()),
        _ => return Err(unread()),
    };
    Ok(Array { shape, values })
}

/// Text of a fixed number of characters, four bytes each.
fn word(bytes: &[u8]) -> String {
    let codes = bytes.as_chunks::<4>().0.iter().map(|c| u32::from_le_bytes(*c));
    codes.take_while(|c| *c != 0).map(|c| char::from_u32(c).unwrap_or('?')).collect()
}

/// The file with these arrays, as `numpy.load` reads it.
///
/// # Errors
/// One sentence: sizes and places in such a file end at 4 GB.
///
/// # Panics
/// When an array's entries do not fill its shape.
pub fn write(arrays: &[(&str, Array)]) -> Result<Vec<u8>, String> {
    let (mut out, mut list) = (Vec::new(), Vec::new());
    for (name, array) in arrays {
        let (name, content, place) = (format!("{name}.npy"), bytes_of(array), out.len() as u32);
        let size = (content.len() as u32).to_le_bytes();
        // version 2.0, nothing special, stored, the first date there is
        let common =
            [&[20, 0, 0, 0, 0, 0, 0, 0, 33, 0][..], &crc32fast::hash(&content).to_le_bytes(), &size, &size]
                .concat();
        let name_len = (name.len() as u16).to_le_bytes();
        out.extend(
            [&LOCAL.to_le_bytes()[..], &common, &name_len, &[0, 0], name.as_bytes(), &content].concat(),
        );
        let rest = [&name_len[..], &[0; 12], &place.to_le_bytes()].concat();
        list.extend([&CENTRAL.to_le_bytes()[..], &[20, 0], &common, &rest, name.as_bytes()].concat());
    }
    if out.len() + list.len() >= ELSEWHERE as usize {
        return Err(format!(
            "it would have {:.1} GB, and such a file holds 4; write fewer episodes into one",
            out.len() as f64 / 1e9
        ));
    }
    let (place, count) = ((out.len() as u32).to_le_bytes(), (arrays.len() as u16).to_le_bytes());
    let size = (list.len() as u32).to_le_bytes();
    out.extend(list);
    out.extend([&END.to_le_bytes()[..], &[0; 4], &count, &count, &size, &place, &[0, 0]].concat());
    Ok(out)
}

fn bytes_of(array: &Array) -> Vec<u8> {
    let n = array.shape.iter().product::<usize>();
    let (kind, content) = match &array.values {
        Values::Numbers(x) => {
            assert_eq!(x.len(), n, "entries of shape {:?}", array.shape);
            ("<f8".to_string(), x.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>())
        }
        Values::Whole(x) => {
            assert_eq!(x.len(), n, "entries of shape {:?}", array.shape);
            ("<i8".to_string(), x.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>())
        }
        Values::Words(words) => {
            assert_eq!(words.len(), n, "entries of shape {:?}", array.shape);
            let longest = words.iter().map(|w| w.chars().count()).max().unwrap_or(0).max(1);
            let padded = |w: &String| {
                let codes = w.chars().map(u32::from).chain(std::iter::repeat(0)).take(longest);
                codes.flat_map(u32::to_le_bytes).collect::<Vec<u8>>()
            };
            (format!("<U{longest}"), words.iter().flat_map(padded).collect())
        }
    };
    let sizes: String = array.shape.iter().map(|s| format!("{s},")).collect();
    let mut header = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': ({sizes}), }}");
    header.extend(std::iter::repeat_n(' ', (64 - (11 + header.len()) % 64) % 64));
    header.push('\n');
    [b"\x93NUMPY\x01\x00", &(header.len() as u16).to_le_bytes()[..], header.as_bytes(), &content].concat()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shape_beyond_what_can_be_counted_is_refused_as_it_is() {
        let header = "{'descr': '<f8', 'fortran_order': False, 'shape': (1099511627776, 1099511627776), }\n";
        let length = (header.len() as u16).to_le_bytes();
        let bytes = [&b"\x93NUMPY\x01\x00"[..], &length, header.as_bytes(), &[0; 64]].concat();
        let said = array(&bytes).map(drop).expect_err("no file has so many");
        assert_eq!(said, "its shape [1099511627776, 1099511627776] has more entries than a file can hold");
    }
    #[test]
    fn a_type_that_is_none_is_refused_as_it_is() {
        for kind in ["", "b", "<", "<U0", "<U4611686018427387904", "\u{e9}", "<f9", "O"] {
            let header = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': (0,), }}\n");
            let length = (header.len() as u16).to_le_bytes();
            let bytes = [&b"\x93NUMPY\x01\x00"[..], &length, header.as_bytes()].concat();
            let said = array(&bytes).map(drop).expect_err("nobody knows what it holds");
            assert_eq!(
                said,
                format!("entries of type '{kind}' are not read; give little-endian numbers or text")
            );
        }
    }
}
