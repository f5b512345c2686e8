//! The corpus of the fuzzer (`just fuzz`), replayed: what once broke a reader, and the inputs that
//! together reach all of its code. No engine is needed for it.

#[path = "../../../fuzz/src/readers.rs"]
mod readers;

use std::{
    fs,
    path::Path,
    time::{Duration, Instant},
};

/// A file of some kilobytes is read in milliseconds; this is for a machine that does other work too.
const LIMIT: Duration = Duration::from_secs(5);

/// The corpus stays small enough to be read by people who clone the repository.
const MOST_FILES: usize = 250;
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
