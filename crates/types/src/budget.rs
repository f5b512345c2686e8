//! The memory that one run of a stage may take.
//!
//! A pitch of 1e-9 mm or a path in micrometres needs more memory than any machine has, and an
//! allocation that fails ends a process without a message. Code that allocates by a number from the
//! user therefore calls [`affordable`] first. It gets an [`Invalid`] that names the number and the
//! remedy.
//!
//! The budget belongs to the process, as its memory does. A binary sets it once, from
//! `--memory-gib`, before any work.

use std::sync::atomic::{AtomicU64, Ordering};

use crate::{Invalid, text::significant};

/// Default memory budget of a process, GiB (2^30 bytes). Larger: a machine with less memory swaps.
/// Smaller: large plans are refused. Chosen so that every case of docs/performance.md fits.
pub const DEFAULT_MEMORY_GIB: f64 = 8.0;

const BYTES_PER_GIB: f64 = (1u64 << 30) as f64;

static MEMORY_BYTES: AtomicU64 = AtomicU64::new((DEFAULT_MEMORY_GIB * BYTES_PER_GIB) as u64);

/// Sets the budget of this process, GiB. Refuses one that is not finite and above 0.
pub fn set_memory_gib(gib: f64) -> Result<(), Invalid> {
    if !(gib.is_finite() && gib > 0.0) {
        let remedy = "give the memory that the run may take, in GiB";
        return Err(Invalid::whole("memory_gib", format!("is {gib}"), remedy));
    }
    MEMORY_BYTES.store((gib * BYTES_PER_GIB) as u64, Ordering::Relaxed);
    Ok(())
}

/// Returns the budget of this process, bytes.
pub fn memory_bytes() -> u64 {
    MEMORY_BYTES.load(Ordering::Relaxed)
}

/// Returns `count` as a whole number of elements if all of them together, at `bytes_each`, fit into the budget.
/// Otherwise the error states their number, their memory and `remedy`.
///
/// `count` is a float because it comes from lengths that a user gave; infinite and NaN are refused.
/// `array` names the array that would be too large.
pub fn affordable(
    array: &'static str,
    count: f64,
    bytes_each: usize,
    remedy: &str,
) -> Result<usize, Invalid> {
    let bytes = count * bytes_each as f64;
    if bytes >= 0.0 && bytes <= memory_bytes() as f64 {
        return Ok(count as usize);
    }
    let problem = format!(
        "would have {count:.3e} elements, {} GiB of the {} GiB that the run may take",
        significant(bytes / BYTES_PER_GIB, 4),
        significant(memory_bytes() as f64 / BYTES_PER_GIB, 4)
    );
    Err(Invalid::whole(array, problem, format!("{remedy}, or give more --memory-gib")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_does_not_fit_is_refused_with_its_size() {
        let fits = memory_bytes() as f64 / 8.0;
        assert_eq!(affordable("point_mm", fits, 8, "coarser"), Ok(fits as usize));
        for count in [fits + 1.0, 1e300, f64::INFINITY, f64::NAN, -1.0] {
            let message = affordable("point_mm", count, 8, "give a coarser pitch").unwrap_err();
            let message = message.to_string();
            assert!(message.starts_with("point_mm: would have"), "{message}");
            assert!(message.contains("give a coarser pitch, or give more --memory-gib"));
        }
    }

    #[test]
    fn a_budget_is_positive_and_finite() {
        for gib in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(set_memory_gib(gib).is_err(), "{gib}");
        }
    }
}
