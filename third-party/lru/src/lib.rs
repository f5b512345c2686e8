//! A cache that forgets what was used least recently, in the interface of the crate `lru`.
//!
//! `hdf5-reader` asks for `lru` 0.16, of which no release mends RUSTSEC-2026-0253 (`pop` is unsound where a destructor
//! panics). The workspace replaces it by this: the eight functions that `hdf5-reader` calls, without unsafe code.
//!
//! ```text
//! entries   key -> (value, time of the last use)
//! uses      time of the last use -> key
//! ```
//!
//! Every operation takes O(log n).

use std::{
    borrow::Borrow,
    collections::{BTreeMap, HashMap},
    hash::Hash,
    num::NonZeroUsize,
};

/// A cache of at most so many entries.
#[derive(Debug)]
pub struct LruCache<K, V> {
    entries: HashMap<K, (V, u64)>,
    uses: BTreeMap<u64, K>,
    most: usize,
    now: u64,
}

impl<K: Hash + Eq + Clone, V> LruCache<K, V> {
    /// At most `most` entries.
    pub fn new(most: NonZeroUsize) -> Self {
        Self { most: most.get(), ..Self::unbounded() }
    }

    /// Any number of entries.
    pub fn unbounded() -> Self {
        Self { entries: HashMap::new(), uses: BTreeMap::new(), most: usize::MAX, now: 0 }
    }

    /// Number of entries.
    pub fn len(&self) -> usize {
        self.entries.len()
    }

    /// Returns true if there is no entry.
    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }

    /// Returns true if the key has an entry; that is no use of it.
    pub fn contains<Q: Hash + Eq + ?Sized>(&self, key: &Q) -> bool
    where
        K: Borrow<Q>,
    {
        self.entries.contains_key(key)
    }

    /// The value of a key; that is no use of it.
    pub fn peek<Q: Hash + Eq + ?Sized>(&self, key: &Q) -> Option<&V>
    where
        K: Borrow<Q>,
    {
        self.entries.get(key).map(|(value, _)| value)
    }

    /// The value of a key, which is used by that.
    pub fn get<Q: Hash + Eq + ?Sized>(&mut self, key: &Q) -> Option<&V>
    where
        K: Borrow<Q>,
    {
        let (value, used) = self.entries.get_mut(key)?;
        let own = self.uses.remove(used)?;
        self.now += 1;
        *used = self.now;
        self.uses.insert(self.now, own);
        Some(value)
    }

    /// Gives a key its value; the one that it had. Where the cache is full the entry that was used least recently goes.
    pub fn put(&mut self, key: K, value: V) -> Option<V> {
        self.now += 1;
        let former = self.entries.insert(key.clone(), (value, self.now));
        if let Some((_, used)) = &former {
            self.uses.remove(used);
        }
        self.uses.insert(self.now, key);
        if self.len() > self.most {
            self.pop_lru();
        }
        former.map(|(value, _)| value)
    }

    /// Takes out the entry that was used least recently.
    pub fn pop_lru(&mut self) -> Option<(K, V)> {
        let (_, key) = self.uses.pop_first()?;
        let (value, _) = self.entries.remove(&key)?;
        Some((key, value))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_entry_that_was_used_least_recently_goes_first() {
        let mut cache = LruCache::new(NonZeroUsize::new(3).unwrap());
        assert!(cache.is_empty());
        for key in 1..=3 {
            assert_eq!(cache.put(key, 10 * key), None);
        }
        assert_eq!(cache.get(&1), Some(&10));
        // Neither is a use.
        assert!(cache.contains(&2));
        assert_eq!(cache.peek(&2), Some(&20));
        assert_eq!(cache.put(4, 40), None);
        assert_eq!((cache.peek(&2), cache.len()), (None, 3));
        assert_eq!(cache.put(3, 33), Some(30));
        assert_eq!(cache.pop_lru(), Some((1, 10)));
        assert_eq!(cache.pop_lru(), Some((4, 40)));
        assert_eq!(cache.pop_lru(), Some((3, 33)));
        assert_eq!(cache.pop_lru(), None);
        assert_eq!(cache.get(&1), None);
    }

    #[test]
    fn a_cache_without_a_bound_keeps_everything() {
        let mut cache = LruCache::unbounded();
        (0..1000).for_each(|key| assert_eq!(cache.put(key, key), None));
        assert_eq!(cache.len(), 1000);
    }
}
