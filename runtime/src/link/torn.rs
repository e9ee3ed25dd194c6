//! What happens when a file that is mapped is made shorter: reading beyond its end is a SIGBUS, which would end plant and loop in silence.
//!
//! After [`watch`] a reader of the links' memory gets zeros from there on instead, which are no valid message, and [`is_torn`] says that it happened: the
//! loop and the plant's runner then brake and end with a code, and a driver is told to brake. Faults of other memory go where they went before.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Once, OnceLock};

/// How the path of every file of the links begins.
const OURS: &[u8] = b"/dev/shm/nearl";

/// What a fault did before.
static BEFORE: OnceLock<libc::sigaction> = OnceLock::new();
static TORN: AtomicBool = AtomicBool::new(false);
static PAGE: AtomicUsize = AtomicUsize::new(4096);

/// True once memory that this process maps has been taken away under it.
pub(crate) fn is_torn() -> bool {
    TORN.load(Ordering::Acquire)
}

/// From now on for the whole process.
pub(crate) fn watch() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        // SAFETY: plain call.
        let page = unsafe { libc::sysconf(libc::_SC_PAGESIZE) };
        PAGE.store(usize::try_from(page).unwrap_or(4096), Ordering::Release);
        let handler: extern "C" fn(libc::c_int, *mut libc::siginfo_t, *mut libc::c_void) = on_sigbus;
        // SAFETY: a struct of numbers, for which zero is a value; its three fields that matter are set.
        unsafe {
            let mut action: libc::sigaction = std::mem::zeroed();
            action.sa_sigaction = handler as usize;
            action.sa_flags = libc::SA_SIGINFO | libc::SA_ONSTACK;
            let mut before: libc::sigaction = std::mem::zeroed();
            libc::sigaction(libc::SIGBUS, std::ptr::null(), &raw mut before);
            let _ = BEFORE.set(before);
            libc::sigaction(libc::SIGBUS, &raw const action, std::ptr::null_mut());
        }
    });
}

/// Puts a page of zeros where the file has ended. Only calls that a signal handler may make: `mmap` is a plain system call here.
extern "C" fn on_sigbus(_: libc::c_int, info: *mut libc::siginfo_t, _: *mut libc::c_void) {
    // SAFETY: the system hands over a valid siginfo_t; the page at a fault beyond a file's end is mapped by this process, and holds nothing.
    unsafe {
        let address = (*info).si_addr() as usize;
        if (*info).si_code == libc::BUS_ADRERR && is_ours(address) {
            let page = PAGE.load(Ordering::Acquire);
            let at = (address & !(page - 1)) as *mut libc::c_void;
            let rights = libc::PROT_READ | libc::PROT_WRITE;
            let flags = libc::MAP_FIXED | libc::MAP_PRIVATE | libc::MAP_ANONYMOUS;
            if libc::mmap(at, page, rights, flags, -1, 0) != libc::MAP_FAILED {
                TORN.store(true, Ordering::Release);
                return;
            }
        }
        // Of another kind, or of others: the access is made again, and does what it would have done.
        match BEFORE.get() {
            Some(before) => drop(libc::sigaction(libc::SIGBUS, before, std::ptr::null_mut())),
            None => drop(libc::signal(libc::SIGBUS, libc::SIG_DFL)),
        }
    }
}

/// Whether `address` lies in a file of the links. Only calls that a signal handler may make.
fn is_ours(address: usize) -> bool {
    let mut maps = Maps::new(address);
    let mut bytes = [0_u8; 1024];
    // SAFETY: plain calls with a path that ends with a zero and a place of the size that is said.
    unsafe {
        let file = libc::open(c"/proc/self/maps".as_ptr(), libc::O_RDONLY | libc::O_CLOEXEC);
        loop {
            let n = libc::read(file, bytes.as_mut_ptr().cast(), bytes.len());
            let Some(read) =
                usize::try_from(n).ok().and_then(|n| bytes.get(..n)).filter(|read| !read.is_empty())
            else {
                break;
            };
            read.iter().for_each(|&byte| maps.take(byte));
        }
        libc::close(file);
    }
    maps.is_ours
}

/// Lines as `7f00-7f10 rw-s 00000000 00:16 1 /dev/shm/nearl-0/arm/newest-state`, byte by byte.
struct Maps {
    address: usize,
    /// Begin and end, as far as they were read.
    range: [usize; 2],
    field: usize,
    /// Bytes of [`OURS`] that the last ones were.
    alike: usize,
    named: bool,
    is_ours: bool,
}

impl Maps {
    fn new(address: usize) -> Maps {
        Maps { address, range: [0; 2], field: 0, alike: 0, named: false, is_ours: false }
    }

    fn take(&mut self, byte: u8) {
        match byte {
            b'\n' => {
                self.is_ours |= self.named && (self.range[0]..self.range[1]).contains(&self.address);
                *self = Maps { is_ours: self.is_ours, ..Maps::new(self.address) };
            }
            b'-' if self.field == 0 => self.field = 1,
            b' ' if self.field == 1 => self.field = 2,
            _ if self.field < 2 => {
                let digit = char::from(byte).to_digit(16).unwrap_or(0) as usize;
                self.range[self.field] = self.range[self.field].wrapping_shl(4) | digit;
            }
            _ => {
                let again = usize::from(byte == OURS[0]);
                self.alike = if byte == OURS[self.alike] { self.alike + 1 } else { again };
                if self.alike == OURS.len() {
                    (self.named, self.alike) = (true, 0);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_of_the_links_is_told_from_that_of_others() {
        let lines = "00400000-00452000 r-xp 00000000 08:02 173521 /usr/bin/near-by\n7f10-7f20 rw-s 0 00:16 1 /dev/shm/nearl-0/arm/newest-state\n\
                     7f20-7f30 rw-s 0 00:16 1 /home/nearl-0/arm\n7f40-7f50 rw-s 0 00:16 1 /dev/shm/nearl.arm.1_2.data (deleted)\n7f60-7f70 rw-p 0 0 0\n";
        for (address, ours) in [
            (0x0040_0010, false),
            (0x7f0f, false),
            (0x7f10, true),
            (0x7f1f, true),
            (0x7f20, false),
            (0x7f45, true),
            (0x7f65, false),
        ] {
            let mut maps = Maps::new(address);
            lines.bytes().for_each(|byte| maps.take(byte));
            assert_eq!(maps.is_ours, ours, "{address:x}");
        }
    }
}
