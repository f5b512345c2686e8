//! Loops over all threads, compiled once.
//!
//! `rayon` compiles its division of the work again for every closure and every chain of iterators, three times each.
//! Here [`for_each`] is the only loop, and it takes its work by reference.
//!
//! No result depends on the number of threads: items have numbers, and results keep their order.

use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};

use ndarray::{ArrayBase, ArrayViewMut, Axis, DataMut, Dimension, RemoveAxis};
use rayon::prelude::*;

/// Smallest number of parts of a loop for every thread, if the loop has so many items. Larger: uneven items are
/// balanced better, and each part costs some 50 ns. Smaller: threads wait for the longest part.
const PIECES_PER_THREAD: usize = 64;

/// Calls `work` once with every number 0, 1, ... below `count`, on all threads.
pub fn for_each(count: usize, work: &(dyn Fn(usize) + Sync)) {
    let most = count.div_ceil(PIECES_PER_THREAD * rayon::current_num_threads()).max(1);
    (0..count).into_par_iter().with_max_len(most).for_each(work);
}

/// Returns `item(0)`, `item(1)`, ... up to `item(count - 1)` in this order, computed on all threads.
pub fn map<R: Send + Sync>(count: usize, item: &(dyn Fn(usize) -> R + Sync)) -> Vec<R> {
    let results: Vec<OnceLock<R>> = (0..count).map(|_| OnceLock::new()).collect();
    for_each(count, &|i| {
        results[i].get_or_init(|| item(i));
    });
    let values = results.into_iter().map(OnceLock::into_inner);
    values.map(|value| value.expect("every item has its result")).collect()
}

/// Calls `work(i, item)` once for every item, on all threads; i counts the items from 0.
pub fn consume<T: Send>(items: impl IntoIterator<Item = T>, work: &(dyn Fn(usize, T) + Sync)) {
    let items: Vec<Mutex<Option<T>>> =
        items.into_iter().map(|item| Mutex::new(Some(item))).collect();
    for_each(items.len(), &|i| {
        let item = locked(&items[i]).take();
        if let Some(item) = item {
            work(i, item);
        }
    });
}

/// Calls `work(workspace, i, item)` once for every item, on all threads. `workspace()` makes a new workspace if none is
/// idle. No two calls use the same one at the same time.
pub fn consume_with<W: Send, T: Send>(
    items: impl IntoIterator<Item = T>,
    workspace: &(dyn Fn() -> W + Sync),
    work: &(dyn Fn(&mut W, usize, T) + Sync),
) {
    let idle = Mutex::new(Vec::new());
    consume(items, &|i, item| {
        let free = locked(&idle).pop();
        let mut own = free.unwrap_or_else(workspace);
        work(&mut own, i, item);
        locked(&idle).push(own);
    });
}

/// Divides a map into bands of `rows` rows, and calls `work(index of the band, band)` once for each. The last band may
/// have fewer rows.
pub fn for_each_band<A: Send, S: DataMut<Elem = A>, D: Dimension + RemoveAxis>(
    map: &mut ArrayBase<S, D>,
    rows: usize,
    work: &(dyn Fn(usize, ArrayViewMut<A, D>) + Sync),
) {
    consume(map.axis_chunks_iter_mut(Axis(0), rows), work);
}

/// Divides a slice into pieces of `length` values, and calls `work(index of the piece, piece)` once for each. The last
/// piece may be shorter.
pub fn for_each_piece<T: Send>(
    values: &mut [T],
    length: usize,
    work: &(dyn Fn(usize, &mut [T]) + Sync),
) {
    consume(values.chunks_mut(length), work);
}

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;

    use super::*;

    #[test]
    fn every_item_is_met_once_and_results_keep_their_order() {
        let squares = map(1000, &|i| i * i);
        assert_eq!(squares, (0..1000).map(|i| i * i).collect::<Vec<_>>());
        let mut numbers = vec![0; 10];
        for_each_piece(&mut numbers, 4, &|k, piece| piece.fill(k + 1));
        assert_eq!(numbers, [1, 1, 1, 1, 2, 2, 2, 2, 3, 3]);
        let mut rows = Array2::zeros((5, 2));
        for_each_band(&mut rows, 2, &|band, mut rows| rows.fill(band as f64));
        assert_eq!(rows.column(0).to_vec(), [0.0, 0.0, 1.0, 1.0, 2.0]);
        assert!(map(0, &|i| i).is_empty());
    }

    #[test]
    fn a_workspace_is_never_shared() {
        let sums = Mutex::new(0);
        consume_with(0..1000, &|| 0, &|own: &mut usize, i, item| {
            *own = item;
            std::thread::yield_now();
            assert_eq!(*own, i);
            *locked(&sums) += *own;
        });
        assert_eq!(*locked(&sums), 499_500);
    }
}
