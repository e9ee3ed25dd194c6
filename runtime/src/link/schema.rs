//! Message layout: one declaration gives the `repr(C)` struct, its schema hash and its type name.
//!
//! iceoryx2 compares the name and the size of a type, not its layout: two builds with swapped fields would
//! connect and misread each other. So the hash of field names, types and offsets is part of the type name (the
//! service then refuses to open) and is repeated in every header (a sample with another hash is refused and counted).

use nearl_controller::task::names::bare;
use std::fmt::Debug;

const FNV_OFFSET: u64 = 0xcbf2_9ce4_8422_2325;
const FNV_PRIME: u64 = 0x0000_0100_0000_01b3;

/// Start value of a schema hash (FNV-1a, 64 bits).
pub const fn hash_start() -> u64 {
    FNV_OFFSET
}

/// FNV-1a over `bytes`, continuing from `hash`.
pub const fn hash_bytes(mut hash: u64, bytes: &[u8]) -> u64 {
    let mut i = 0;
    while i < bytes.len() {
        hash = (hash ^ bytes[i] as u64).wrapping_mul(FNV_PRIME);
        i += 1;
    }
    hash
}

/// FNV-1a over the eight bytes of `number`, continuing from `hash`.
pub const fn hash_number(hash: u64, number: u64) -> u64 {
    hash_bytes(hash, &number.to_le_bytes())
}

/// One field of a message: name, type and offset go into the hash.
pub const fn hash_field(hash: u64, name: &str, type_name: &str, offset: usize) -> u64 {
    hash_number(hash_bytes(hash_bytes(hash, name.as_bytes()), type_name.as_bytes()), offset as u64)
}

/// The 64-bit hash that identifies a list of names (joints, observation entries), order included; with braces around a name it is the same name.
pub fn hash_names<S: AsRef<str>>(names: impl IntoIterator<Item = S>) -> u64 {
    names
        .into_iter()
        .fold(hash_start(), |hash, name| hash_bytes(hash_bytes(hash, bare(name.as_ref()).as_bytes()), b"\n"))
}

/// First field of every message.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Header {
    /// Schema hash of the sender's type; differs between builds whose layouts differ.
    pub schema: u64,
    /// Start of the sender: changes when the process behind the port changes.
    pub epoch: u64,
    /// Counts the messages of one sender and topic from 1; a gap means lost messages.
    pub seq: u64,
    /// Monotonic time of sending \[ns\].
    pub stamp: u64,
}

/// A plain `repr(C)` struct of numbers that may be sent between processes.
///
/// # Safety
/// Every bit pattern must be a valid value, and the struct must hold no padding-dependent or pointer field.
pub unsafe trait Message: Copy + Debug + Send + Sync + 'static {
    /// Topic, and the readable part of the type name.
    const TOPIC: &'static str;
    /// Hash over version, field names, types, offsets and the size.
    const SCHEMA: u64;

    /// The header.
    fn header(&self) -> &Header;
    /// The header, to be filled by the port.
    fn header_mut(&mut self) -> &mut Header;

    /// All numbers zero.
    fn zeroed() -> Self {
        // SAFETY: every bit pattern is a value, by the contract of the trait.
        unsafe { std::mem::zeroed() }
    }
}

/// A message that travels in an iceoryx2 queue.
pub trait Queued: Message + iceoryx2::prelude::ZeroCopySend {
    /// Messages kept for a subscriber that is behind; the oldest is dropped.
    const BUFFER: usize;
    /// Messages a late subscriber still gets.
    const HISTORY: usize;
    /// Largest number of subscribers.
    const SUBSCRIBERS: usize;
}

/// Bytes of a word: messages are rows of them.
pub(crate) const WORD: usize = size_of::<u64>();

/// Which words of a message are in use: the fixed ones in front, then a part of each array.
pub(crate) trait Arrays {
    /// Words before the first array.
    const FIXED: usize;
    /// One range for each array.
    type Ranges: IntoIterator<Item = std::ops::Range<usize>> + PartialEq;
    /// The words of each array's used entries.
    fn arrays(&self) -> Self::Ranges;
}

/// Declares a message, `message! { Name, "topic", version { field: type, .. } }`, and the queue it travels in if there is one:
/// `version, buffer, history, subscribers`. Ends that disagree on a message named `beside` another disagree on that one too.
#[macro_export]
macro_rules! link_message {
    ($(#[$meta:meta])* $name:ident, $topic:literal, version $version:literal $(, beside $beside:ident)*, buffer $buffer:literal,
     history $history:literal, subscribers $subscribers:literal { $($fields:tt)* }) => {
        $crate::link_message! { $(#[$meta])* $name, $topic, version $version $(, beside $beside)* { $($fields)* } }
        impl $crate::link::schema::Queued for $name {
            const BUFFER: usize = $buffer;
            const HISTORY: usize = $history;
            const SUBSCRIBERS: usize = $subscribers;
        }
        // SAFETY: `repr(C)`, self-contained, no pointers.
        unsafe impl iceoryx2::prelude::ZeroCopySend for $name {
            unsafe fn type_name() -> &'static str {
                static NAME: std::sync::OnceLock<String> = std::sync::OnceLock::new();
                NAME.get_or_init(|| format!("nearl.{}.v{}.{:016x}", $topic, $version, <$name as $crate::link::Message>::SCHEMA))
            }
        }
    };
    ($(#[$meta:meta])* $name:ident, $topic:literal, version $version:literal $(, beside $beside:ident)*
     { $($(#[$doc:meta])* $field:ident : $type:ty,)* }) => {
        $(#[$meta])*
        #[repr(C)]
        #[derive(Clone, Copy, Debug)]
        pub struct $name {
            /// Filled by the sending port.
            pub header: $crate::link::Header,
            $($(#[$doc])* pub $field: $type,)*
        }
        // SAFETY: only numbers and arrays of numbers are used as field types.
        unsafe impl $crate::link::Message for $name {
            const TOPIC: &'static str = $topic;
            const SCHEMA: u64 = {
                use $crate::link::schema::{hash_bytes, hash_field, hash_number, hash_start};
                let hash = hash_number(hash_bytes(hash_start(), $topic.as_bytes()), $version);
                $(let hash = hash_number(hash, <$beside as $crate::link::Message>::SCHEMA);)*
                $(let hash = hash_field(hash, stringify!($field), stringify!($type), std::mem::offset_of!($name, $field));)*
                hash_number(hash, std::mem::size_of::<$name>() as u64)
            };
            fn header(&self) -> &$crate::link::Header { &self.header }
            fn header_mut(&mut self) -> &mut $crate::link::Header { &mut self.header }
        }
    };
}
pub(crate) use link_message as message;

#[cfg(test)]
mod tests {
    use super::*;

    #[allow(unreachable_pub)]
    mod a {
        super::message! { /// Two numbers.
        Pair, "pair", version 1, buffer 1, history 0, subscribers 1 { /// x
        x: u64, /// y
        y: f64, } }
    }
    #[allow(unreachable_pub)]
    mod swapped {
        super::message! { /// The same fields in another order.
        Pair, "pair", version 1, buffer 1, history 0, subscribers 1 { /// y
        y: f64, /// x
        x: u64, } }
    }

    #[test]
    fn same_size_and_swapped_fields_have_another_hash() {
        assert_eq!(std::mem::size_of::<a::Pair>(), std::mem::size_of::<swapped::Pair>());
        assert_ne!(a::Pair::SCHEMA, swapped::Pair::SCHEMA);
    }

    #[test]
    fn a_peer_with_another_layout_is_refused() {
        use crate::link::service::Bus;
        let name = crate::link::RobotName::new(&format!("t{}-schema", std::process::id())).unwrap();
        let bus = Bus::join(&name).unwrap();
        let _first = bus.outbox::<a::Pair>().unwrap();
        bus.inbox::<a::Pair>().unwrap();
        let error = bus.inbox::<swapped::Pair>().err().unwrap();
        assert_eq!(error, crate::link::LinkError::Schema { name: name.clone(), topic: "pair" });
        drop(_first);
        drop(bus);
        crate::link::remove_files(&name);
    }

    #[test]
    fn hash_is_fnv_1a() {
        // Published test vectors of FNV-1a, 64 bits.
        assert_eq!(hash_bytes(hash_start(), b"a"), 0xaf63_dc4c_8601_ec8c);
        assert_eq!(hash_bytes(hash_start(), b"foobar"), 0x8594_4171_f739_67e8);
    }

    #[test]
    fn names_are_hashed_with_their_borders() {
        assert_ne!(hash_names(["ab", "c"]), hash_names(["a", "bc"]));
    }
}
