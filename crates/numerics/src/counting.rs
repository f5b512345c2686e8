//! Counting sort for keys that are small numbers, in time proportional to the number of items and
//! keys.

/// Item numbers grouped by their keys, keys ascending. Items of the same key stay in ascending order.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Grouped {
    /// Index in `items` of the first item of every key: the items of key k are `items[first[k]..first[k + 1]]`.
    first: Vec<u32>,
    items: Vec<u32>,
}

impl Grouped {
    /// Groups the items 0, 1, 2, ... (fewer than 2^32) by their keys. `key_of_item` gives their keys in order, all
    /// below `keys`; items with the key `None` are left out.
    pub fn new(keys: usize, key_of_item: impl Iterator<Item = Option<usize>> + Clone) -> Self {
        // Element k + 1 first counts the items of key k, then those of all keys up to k.
        let mut first = vec![0_u32; keys + 1];
        key_of_item.clone().flatten().for_each(|k| first[k + 1] += 1);
        for k in 0..keys {
            first[k + 1] += first[k];
        }
        let mut next = first.clone();
        let mut items = vec![0; first[keys] as usize];
        for (item, key) in key_of_item.enumerate() {
            if let Some(k) = key {
                items[next[k] as usize] = item as u32;
                next[k] += 1;
            }
        }
        Self { first, items }
    }

    /// Returns the numbers of the items with this key, ascending.
    pub fn group(&self, key: usize) -> &[u32] {
        &self.items[self.first(key)..self.first(key + 1)]
    }

    /// Returns the index of the first item of a key among all items. For the key after the last, it is the number
    /// of items.
    pub fn first(&self, key: usize) -> usize {
        self.first[key] as usize
    }

    /// Returns the numbers of all items that have a key, grouped by key.
    pub fn items(&self) -> &[u32] {
        &self.items
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_a_stable_sort_by_key() {
        let keys: Vec<Option<usize>> =
            (0..500).map(|i| (i % 7 != 3).then_some((i * i + 5 * i) % 31)).collect();
        // Key 31 has no item.
        let grouped = Grouped::new(32, keys.iter().copied());
        let mut expected: Vec<u32> = (0..500).filter(|i| keys[*i as usize].is_some()).collect();
        expected.sort_by_key(|i| keys[*i as usize]);
        assert_eq!(grouped.items(), expected);
        for k in 0..32 {
            let of_key: Vec<u32> =
                expected.iter().copied().filter(|i| keys[*i as usize] == Some(k)).collect();
            assert_eq!(grouped.group(k), of_key);
        }
        assert_eq!(grouped.first(32), expected.len());
    }

    #[test]
    fn nothing_is_grouped_into_nothing() {
        let none = Grouped::new(3, std::iter::empty());
        assert!((0..3).all(|k| none.group(k).is_empty()) && none.items().is_empty());
    }
}
