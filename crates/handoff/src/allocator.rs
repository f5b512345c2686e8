//! Memory allocator of every binary: mimalloc (a fast general allocator), which keeps the memory budget of the
//! process.
//!
//! If the system grants huge pages, large arrays use them, and the process keeps them for the next
//! array. With the allocator of the C library, the first access to pages of 4 KiB takes a third of
//! the time of the large cases of docs/performance.md.
//!
//! Counts that depend on a user's numbers are refused before they are allocated
//! ([`planish_types::budget::affordable`]). Other memory can still exceed `--memory-gib`, or the
//! system can refuse it. The process then ends with a message and the exit code 2, whereas the
//! standard library would abort it. Staged files of the run are removed; visible files stay as they
//! are.

use std::{
    alloc::{GlobalAlloc, Layout},
    cell::Cell,
    io::Write,
    sync::atomic::{AtomicBool, AtomicI64, Ordering},
};

use mimalloc::MiMalloc;
use planish_types::{budget, text::significant};

use crate::publish;

/// Net bytes (64 KiB) that a thread allocates or frees before it adds them to the common counter. Larger: the process
/// exceeds its budget by more before it ends. Smaller: more writes to a counter that all cores share, each of which can
/// cost more than an allocation.
const REPORTED_BYTES: i64 = 1 << 16;

/// Bytes in use that all threads have added to the common counter.
static REPORTED: AtomicI64 = AtomicI64::new(0);

/// True once the process is ending. From then on the budget is not checked, so that the end can
/// allocate memory.
static ENDING: AtomicBool = AtomicBool::new(false);

thread_local! {
    /// Bytes of this thread that are not in the common counter yet.
    static UNREPORTED: Cell<i64> = const { Cell::new(0) };
}

/// Allocator mimalloc within the memory budget of the process. A program selects it:
///
/// ```
/// #[global_allocator]
/// static ALLOCATOR: planish_handoff::Allocator = planish_handoff::Allocator;
/// ```
#[derive(Debug)]
pub struct Allocator;

impl Allocator {
    /// Adds `bytes` (negative if freed) to the count of this thread. If the count reaches [`REPORTED_BYTES`], it goes
    /// to the common counter, and the process ends if that then exceeds the budget.
    fn count(bytes: i64) {
        // A thread that ends has no counter any more; memory that it frees afterwards is not
        // counted.
        let _ = UNREPORTED.try_with(|unreported| {
            let sum = unreported.get() + bytes;
            if sum.abs() < REPORTED_BYTES {
                unreported.set(sum);
                return;
            }
            unreported.set(0);
            let held = REPORTED.fetch_add(sum, Ordering::Relaxed) + sum;
            let budget = i64::try_from(budget::memory_bytes()).unwrap_or(i64::MAX);
            if sum > 0 && held > budget && !ENDING.swap(true, Ordering::Relaxed) {
                let [held, budget] =
                    [held, budget].map(|n| significant(n as f64 / (1u64 << 30) as f64, 3));
                end(&format!(
                    "needs {held} GiB, more than the {budget} GiB that it may take; give a coarser map or \
                     path, or more --memory-gib"
                ));
            }
        });
    }

    /// Returns `pointer`; ends the process if it is null, because the system returned no memory.
    fn checked(pointer: *mut u8, layout: Layout) -> *mut u8 {
        if pointer.is_null() && !ENDING.swap(true, Ordering::Relaxed) {
            let mib = layout.size() as f64 / (1u64 << 20) as f64;
            end(&format!(
                "the system has no {mib:.0} MiB more; close other programs, or give a \
                          coarser map or path"
            ));
        }
        pointer
    }
}

/// Prints the error message `problem`, removes the temporary files of the run, and ends the process with exit code 2.
fn end(problem: &str) -> ! {
    let _ = writeln!(std::io::stderr(), "error: memory: {problem}");
    publish::remove_all_siblings();
    std::process::exit(2)
}

// SAFETY: every call is passed on to mimalloc unchanged, and its result is returned unchanged;
// counting touches neither pointer nor memory.
#[allow(unsafe_code)] // a global allocator cannot be written without
unsafe impl GlobalAlloc for Allocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        Self::count(layout.size() as i64);
        Self::checked(unsafe { MiMalloc.alloc(layout) }, layout)
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        Self::count(layout.size() as i64);
        Self::checked(unsafe { MiMalloc.alloc_zeroed(layout) }, layout)
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        Self::count(-(layout.size() as i64));
        unsafe { MiMalloc.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        Self::count(size as i64 - layout.size() as i64);
        Self::checked(unsafe { MiMalloc.realloc(pointer, layout, size) }, layout)
    }
}
