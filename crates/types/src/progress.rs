//! Progress of a computation, reported to one watcher of the process.
//!
//! A library knows neither clock nor terminal. It reports the fraction of its work that is done. A program that shows
//! this fraction has called [`watch`] before. Work that consists of several parts assigns each part an interval of the
//! whole:
//!
//! ```text
//! reported = first + (last - first) fraction    of the part [first, last] that is under way
//! ```
//!
//! Fractions of iterations are estimates, see [`of_convergence`]; no result depends on them. Like
//! the [budget](crate::budget), the progress belongs to the process. Two computations at once
//! report to the same watcher in turn.

use std::sync::{
    Mutex, MutexGuard, OnceLock, PoisonError,
    atomic::{AtomicUsize, Ordering},
};

type Watcher = Box<dyn Fn(f64) + Send + Sync>;

static WATCHER: OnceLock<Watcher> = OnceLock::new();

static ROUND_WATCHER: OnceLock<Box<dyn Fn() + Send + Sync>> = OnceLock::new();

/// State of the progress: first and last fraction of the part under way, and the largest fraction
/// reported so far; all from 0 to 1.
static UNDER_WAY: Mutex<([f64; 2], f64)> = Mutex::new(([0.0, 1.0], 0.0));

fn under_way() -> MutexGuard<'static, ([f64; 2], f64)> {
    UNDER_WAY.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Registers `watcher`, which gets the fraction of the work that is done, 0 to 1, never smaller
/// than before. Only the first watcher of a process is registered.
pub fn watch(watcher: impl Fn(f64) + Send + Sync + 'static) {
    let _ = WATCHER.set(Box::new(watcher));
}

/// Registers `watcher`, which is called at the end of every round of an iterative method. Only the first watcher of a
/// process is registered.
pub fn watch_rounds(watcher: impl Fn() + Send + Sync + 'static) {
    let _ = ROUND_WATCHER.set(Box::new(watcher));
}

/// Reports the end of a round to the watcher of rounds, so that it can measure the time of a round.
pub fn round_ended() {
    if let Some(watcher) = ROUND_WATCHER.get() {
        watcher();
    }
}

/// Reports the fraction of the current part that is done, 0 to 1. It does nothing without a watcher.
pub fn done(fraction: f64) {
    let Some(watcher) = WATCHER.get() else { return };
    let reported = {
        let mut state = under_way();
        state.1 = state.1.max(within(state.0, fraction));
        state.1
    };
    watcher(reported);
}

/// Runs `work`, which is part number `k` (from 0) of `n` equal parts of the current part, and reports its end.
pub fn part<T>(k: usize, n: usize, work: impl FnOnce() -> T) -> T {
    let whole = under_way().0;
    under_way().0 = [k, k + 1].map(|k| within(whole, k as f64 / n as f64));
    let result = work();
    under_way().0 = whole;
    done((k + 1) as f64 / n as f64);
    result
}

/// Counter of equal pieces of work, which threads finish in any order.
pub struct PieceCounter {
    count: usize,
    ended: AtomicUsize,
}

impl PieceCounter {
    /// Returns a counter of `count` pieces, none of which has ended.
    pub fn new(count: usize) -> Self {
        Self { count, ended: AtomicUsize::new(0) }
    }

    /// Counts one more piece as ended; returns the fraction of all pieces that has ended.
    pub fn one_more(&self) -> f64 {
        (self.ended.fetch_add(1, Ordering::Relaxed) + 1) as f64 / self.count as f64
    }
}

/// Returns a function that takes the excess of an iteration after every step and reports the progress. The excess is
/// relative to the tolerance: the iteration ends when it is 1 or less.
pub fn of_excess() -> impl FnMut(f64) {
    let mut first = None;
    move |excess| done(of_convergence(*first.get_or_insert(excess), excess, 1.0))
}

/// Returns the fraction of the whole at the fraction `fraction` of the part from `first` to `last`.
fn within([first, last]: [f64; 2], fraction: f64) -> f64 {
    first + (last - first) * fraction.clamp(0.0, 1.0)
}

/// Returns the estimated fraction of an iteration that is done, 0 to 1. The quantity falls geometrically from
/// `first` to `last` and is now `now`:
///
/// ```text
/// log(first / now) / log(first / last)
/// ```
pub fn of_convergence(first: f64, now: f64, last: f64) -> f64 {
    let fraction = (first / now).ln() / (first / last).ln();
    if fraction.is_finite() { fraction.clamp(0.0, 1.0) } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    // One test: the watcher is that of the process.
    #[test]
    fn parts_of_parts_tell_their_fraction_of_the_whole() {
        done(0.9); // nobody watches yet, and nothing is kept
        let told = std::sync::Arc::new(Mutex::new(Vec::new()));
        let to = told.clone();
        watch(move |fraction| to.lock().unwrap().push(fraction));
        part(0, 2, || {
            done(0.5);
            part(1, 2, || done(0.5));
        });
        done(0.1); // never less than before
        part(1, 2, || {
            let mut tell = of_excess();
            tell(100.0);
            tell(10.0);
            done(2.0);
        });
        let expected = [0.25, 0.375, 0.5, 0.5, 0.5, 0.5, 0.75, 1.0, 1.0];
        assert_eq!(*told.lock().unwrap(), expected);
    }

    #[test]
    fn pieces_count_up_to_the_whole() {
        let pieces = PieceCounter::new(4);
        let fractions = [0; 4].map(|_| pieces.one_more());
        assert_eq!(fractions, [0.25, 0.5, 0.75, 1.0]);
    }

    #[test]
    fn a_geometric_fall_is_linear() {
        let half = of_convergence(1.0, 1e-2, 1e-4);
        // Rounding of logarithms.
        assert!((half - 0.5).abs() < 1e-15, "{half}");
        assert_eq!(of_convergence(1.0, 2.0, 1e-4), 0.0);
        assert_eq!(of_convergence(1.0, 1e-9, 1e-4), 1.0);
        assert_eq!(of_convergence(f64::INFINITY, 1.0, 1e-4), 0.0);
        assert_eq!(of_convergence(0.0, 0.0, 1e-4), 0.0);
    }
}
