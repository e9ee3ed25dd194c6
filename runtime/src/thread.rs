//! What the operating system is asked for: priority, core, locked memory, exact timers. Best effort by default, with
//! the reason of each refusal; in strict mode a refusal is an error.

use std::num::NonZeroU64;

/// SCHED_FIFO priority of the loop where nothing else is asked for: above ordinary real-time work, below the kernel's own threads at 50.
pub const PRIORITY: i32 = 40;

/// Wishes for one thread and its process.
#[derive(Clone, Copy, Debug)]
pub struct ThreadSettings {
    /// SCHED_FIFO priority, 1 to 99; none keeps the normal scheduler.
    pub priority: Option<i32>,
    /// Core to stay on.
    pub cpu: Option<usize>,
    /// Lock all memory of the process.
    pub lock_memory: bool,
}

impl Default for ThreadSettings {
    /// [`PRIORITY`] on any core, memory locked.
    fn default() -> Self {
        ThreadSettings { priority: Some(PRIORITY), cpu: None, lock_memory: true }
    }
}

/// What a thread cost the system.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct Usage {
    /// Page faults served without reading from a disk.
    pub minor_faults: u64,
    /// Page faults that read from a disk.
    pub major_faults: u64,
    /// Context switches because the thread waited.
    pub voluntary_switches: u64,
    /// Those among them for a state that was late: once a tick the real-time thread sleeps for its state.
    pub late_waits: u64,
    /// Context switches because another thread was given the core.
    pub involuntary_switches: u64,
    /// Heap allocations, in a program that counts them.
    pub allocations: Option<u64>,
}

/// Heap allocations of the calling thread so far, in a program whose allocator counts them.
pub type CountAllocations = fn() -> u64;

impl Usage {
    /// Of the calling thread since its start.
    pub(crate) fn of_this_thread(allocations: Option<CountAllocations>) -> Usage {
        // SAFETY: a struct of numbers, for which zero is a value.
        let mut usage: libc::rusage = unsafe { std::mem::zeroed() };
        // SAFETY: plain call that fills the struct.
        unsafe { libc::getrusage(libc::RUSAGE_THREAD, &raw mut usage) };
        let count = |n: libc::c_long| n.max(0) as u64;
        Usage {
            minor_faults: count(usage.ru_minflt),
            major_faults: count(usage.ru_majflt),
            voluntary_switches: count(usage.ru_nvcsw),
            late_waits: 0,
            involuntary_switches: count(usage.ru_nivcsw),
            allocations: allocations.map(|count| count()),
        }
    }

    pub(crate) fn since(self, before: Usage) -> Usage {
        Usage {
            minor_faults: self.minor_faults - before.minor_faults,
            major_faults: self.major_faults - before.major_faults,
            voluntary_switches: self.voluntary_switches - before.voluntary_switches,
            late_waits: self.late_waits - before.late_waits,
            involuntary_switches: self.involuntary_switches - before.involuntary_switches,
            allocations: self.allocations.map(|count| count - before.allocations.unwrap_or(0)),
        }
    }
}

/// Asks for `settings` on the calling thread; returns one sentence for each refusal.
pub fn prepare(settings: &ThreadSettings) -> Vec<String> {
    // Sleeps of normal threads are rounded up by 50 us unless asked otherwise.
    let _ = rustix::thread::set_current_timer_slack(NonZeroU64::new(1));
    let results =
        [settings.lock_memory.then(lock_memory), settings.cpu.map(stay_on), settings.priority.map(be_first)];
    touch_stack();
    results.into_iter().flatten().filter_map(Result::err).collect()
}

/// For the threads that exchange messages in each tick: exact timers, and ahead of ordinary work if that is allowed. They yield
/// while they poll, so at the `priority` of the real-time thread each of them gets its turn even on a single core.
pub(crate) fn be_prompt(priority: Option<i32>) {
    let _ = rustix::thread::set_current_timer_slack(NonZeroU64::new(1));
    if priority.is_some_and(|p| be_first(p).is_ok()) {
        return;
    }
    // SAFETY: plain call; on Linux it changes the calling thread only. Without the right it changes nothing.
    unsafe { libc::setpriority(libc::PRIO_PROCESS, 0, -15) };
}

fn lock_memory() -> Result<(), String> {
    use rustix::process::{Resource, getrlimit};
    // With a limit, locking all future memory would make later allocations fail: worse than a page fault.
    if let Some(limit) = getrlimit(Resource::Memlock).current
        && !rustix::process::geteuid().is_root()
    {
        return Err(format!(
            "memory is not locked: the limit is {} kB; raise it with `ulimit -l unlimited`",
            limit / 1024
        ));
    }
    keep_memory();
    let all = rustix::mm::MlockAllFlags::CURRENT | rustix::mm::MlockAllFlags::FUTURE;
    rustix::mm::mlockall(all)
        .map_err(|e| format!("memory is not locked ({e}): raise the limit with `ulimit -l unlimited`"))
}

/// Lets the allocator keep what it was given. Each return to the system, and each large allocation of its own mapping, takes the
/// lock of the process's memory map, and waiting for it can cost a prompt thread many periods.
fn keep_memory() {
    #[cfg(target_env = "gnu")]
    for (parameter, value) in [(libc::M_MMAP_MAX, 0), (libc::M_TRIM_THRESHOLD, libc::c_int::MAX)] {
        // SAFETY: plain calls that set a number each.
        unsafe { libc::mallopt(parameter, value) };
    }
}

fn stay_on(cpu: usize) -> Result<(), String> {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let refused =
        |reason: String| format!("the loop is not bound to core {cpu} ({reason}): choose another core");
    if cpu >= rustix::thread::CpuSet::MAX_CPU {
        return Err(refused(format!("this process may use {cores} cores")));
    }
    let mut set = rustix::thread::CpuSet::new();
    set.set(cpu);
    rustix::thread::sched_setaffinity(None, &set).map_err(|e| refused(e.to_string()))
}

fn be_first(priority: i32) -> Result<(), String> {
    let parameters = libc::sched_param { sched_priority: priority };
    // SAFETY: plain call with a valid struct; thread 0 is the caller.
    if unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO, &parameters) } == 0 {
        return Ok(());
    }
    let reason = std::io::Error::last_os_error();
    Err(format!(
        "no real-time priority {priority} ({reason}): run with CAP_SYS_NICE or an rtprio limit of {priority}"
    ))
}

/// Lets the builder of controllers step back behind the loop. Not to the very end: a thread that is starved while it holds a
/// lock of the process (the allocator's, that of the memory map) holds up the others.
pub(crate) fn be_patient() {
    let parameters = libc::sched_param { sched_priority: 0 };
    // SAFETY: as above. A refusal only means the normal scheduler.
    unsafe { libc::sched_setscheduler(0, libc::SCHED_BATCH, &parameters) };
    // SAFETY: on Linux the call changes the calling thread only.
    unsafe { libc::setpriority(libc::PRIO_PROCESS, 0, 5) };
}

/// Touches 256 kB of stack so that no tick meets a page fault there.
#[inline(never)]
fn touch_stack() {
    let mut stack = [0_u8; 256 << 10];
    for page in stack.iter_mut().step_by(4096) {
        // SAFETY: a valid place of our own array; volatile so that it is not left out.
        unsafe { std::ptr::write_volatile(page, 1) };
    }
}
