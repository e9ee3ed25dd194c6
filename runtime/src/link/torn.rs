//! What happens when a file that is mapped is made shorter: reading beyond its end is a SIGBUS, which would end plant and loop in silence.
//!
//! After [`watch`] a reader gets zeros from there on instead, which are no valid message, and [`is_torn`] says that it happened: the loop and the
//! plant's runner then brake and end with a code.

use std::sync::Once;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

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
            libc::sigaction(libc::SIGBUS, &raw const action, std::ptr::null_mut());
        }
    });
}

/// Puts a page of zeros where the file has ended. Only calls that a signal handler may make: `mmap` is a plain system call here.
extern "C" fn on_sigbus(_: libc::c_int, info: *mut libc::siginfo_t, _: *mut libc::c_void) {
    // SAFETY: the system hands over a valid siginfo_t; the page at a fault beyond a file's end is mapped by this process, and holds nothing.
    unsafe {
        let address = (*info).si_addr() as usize;
        if (*info).si_code == libc::BUS_ADRERR && address != 0 {
            let page = PAGE.load(Ordering::Acquire);
            let at = (address & !(page - 1)) as *mut libc::c_void;
            let rights = libc::PROT_READ | libc::PROT_WRITE;
            let flags = libc::MAP_FIXED | libc::MAP_PRIVATE | libc::MAP_ANONYMOUS;
            if libc::mmap(at, page, rights, flags, -1, 0) != libc::MAP_FAILED {
                TORN.store(true, Ordering::Release);
                return;
            }
        }
        // Of another kind: the access is made again, and ends the process as it would have.
        libc::signal(libc::SIGBUS, libc::SIG_DFL);
    }
}
