//! The allocator of every binary: mimalloc within the memory budget of the process.
//!
//! Large arrays come on huge pages where the system grants them, and stay with the process for the next
//! array. With the allocator of the C library the first touch of 4 KiB pages takes a third of the time
//! of the large cases of docs/performance.md.
//!
//! Counts that a user's numbers decide are refused before they are allocated
//! ([`planish_types::budget::affordable`]). What still grows beyond `--memory-gib`, or cannot be had
//! from the system, ends the process with a message and the exit code 2, where the standard library
//! would abort it. What the run has staged is removed; nothing that is shown is touched.

use std::{
    alloc::{GlobalAlloc, Layout},
    cell::Cell,
    io::Write,
    sync::atomic::{AtomicBool, AtomicI64, Ordering},
};

use mimalloc::MiMalloc;
use planish_types::budget;

use crate::publish;

/// Bytes that a thread allocates or frees before it says so to the others: a counter that both cores
/// write at every allocation would cost more than the allocation.
const REPORTED_BYTES: i64 = 1 << 16;

/// Bytes that all threads have reported.
static REPORTED: AtomicI64 = AtomicI64::new(0);

/// The end has begun: it may allocate what it needs.
static ENDING: AtomicBool = AtomicBool::new(false);

thread_local! {
    /// Bytes of this thread that it has not reported.
    static UNREPORTED: Cell<i64> = const { Cell::new(0) };
}

/// mimalloc within the memory budget of the process; a program chooses it:
///
/// ```
/// #[global_allocator]
/// static ALLOCATOR: planish_handoff::Allocator = planish_handoff::Allocator;
/// ```
#[derive(Debug)]
pub struct Allocator;

impl Allocator {
    /// Counts `bytes` more (less where negative); ends the process where that is beyond the budget.
    fn count(bytes: i64) {
        // A thread that ends has no counter any more: what it still frees is not counted.
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
                let gib = |bytes: i64| bytes as f64 / (1u64 << 30) as f64;
                end(&format!(
                    "needs {:.2} GiB, more than the {:.2} GiB that it may take; give a coarser map or \
                     path, or more --memory-gib",
                    gib(held),
                    gib(budget)
                ));
            }
        });
    }

    /// Ends the process where the system gave nothing.
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

/// The message of a stage that could not run, its temporary files away, exit code 2.
fn end(problem: &str) -> ! {
    let _ = writeln!(std::io::stderr(), "error: memory: {problem}");
    publish::remove_all_siblings();
    std::process::exit(2)
}

// SAFETY: every call is passed on to mimalloc unchanged, and what it returns is returned unchanged;
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
