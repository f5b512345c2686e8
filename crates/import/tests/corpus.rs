//! The corpus of the fuzzer (`just fuzz`), replayed: inputs that once broke a reader, and inputs that
//! together reach all of its code. The test needs no fuzzing engine.

#[path = "../../../fuzz/src/readers.rs"]
mod readers;

use std::{
    fs,
    path::Path,
    time::{Duration, Instant},
};

/// Longest time for one file, s. Larger: the test finds a slow reader later. Smaller: it fails on a busy
/// machine. Chosen: a file of some kilobytes is read in milliseconds.
const LIMIT: Duration = Duration::from_secs(5);

/// Largest number of files of the corpus. Larger: a clone of the repository takes more disk. Smaller: fewer
/// inputs can stay.
const MOST_FILES: usize = 250;
/// Largest file of the corpus, bytes. Larger: a clone of the repository takes more disk. Smaller: some
/// inputs are too large.
const LARGEST_BYTES: usize = 16 << 10;

#[test]
fn every_reader_returns_on_its_corpus() {
    readers::prepare();
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/corpus");
    let mut files = 0;
    for (name, reader) in readers::READERS {
        let mut inputs: Vec<_> = fs::read_dir(corpus.join(name))
            .unwrap_or_else(|e| panic!("no corpus for {name}: {e}"))
            .map(|entry| entry.unwrap().path())
            .collect();
        inputs.sort();
        assert!(!inputs.is_empty(), "{name}");
        for input in inputs {
            let bytes = fs::read(&input).unwrap();
            assert!(bytes.len() <= LARGEST_BYTES, "{}", input.display());
            let started = Instant::now();
            reader(&bytes);
            assert!(started.elapsed() < LIMIT, "{} takes {:?}", input.display(), started.elapsed());
            files += 1;
        }
    }
    println!("{files} inputs");
    assert!(files <= MOST_FILES, "{files}");
    let known: Vec<_> = readers::READERS.iter().map(|r| r.0).collect();
    for entry in fs::read_dir(corpus).unwrap() {
        let name = entry.unwrap().file_name().to_string_lossy().into_owned();
        assert!(known.contains(&name.as_str()), "a corpus without a reader: {name}");
    }
}
