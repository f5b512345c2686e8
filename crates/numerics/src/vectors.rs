//! Loops compiled for the vectors of the processor that runs them.
//!
//! A binary is compiled for the oldest processor that may run it, and so for its narrowest vectors. What is done within
//! [`vectorised`] is compiled for wider ones, too, and `pulp` chooses among them when the program runs. The compiler keeps
//! the order of sums and never contracts a product and a sum: every bit is the same on all of them.

use pulp::Arch;

/// Does `work`, a closure with the attribute `#[inline(always)]` which calls nothing that is not inlined, too: only what is
/// inlined here is compiled again.
#[inline(always)]
pub fn vectorised<R>(work: impl FnOnce() -> R) -> R {
    Arch::new().dispatch(work)
}
