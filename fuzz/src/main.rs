//! libFuzzer on one reader: `PLANISH_READER=fits planish-fuzz [flags of libFuzzer] corpus`.
//! `just fuzz` runs all of them.

#![no_main]

mod readers;

use std::{
    sync::{
        OnceLock,
        atomic::{AtomicU64, Ordering},
    },
    time::Instant,
};

static READER: OnceLock<fn(&[u8])> = OnceLock::new();

/// Longest time that an input took, us.
static SLOWEST_US: AtomicU64 = AtomicU64::new(0);

libfuzzer_sys::fuzz_target!(
    init: {
        let wanted = std::env::var("PLANISH_READER").unwrap_or_default();
        let names: Vec<&str> = readers::READERS.iter().map(|r| r.0).collect();
        let Some(found) = readers::READERS.iter().find(|r| r.0 == wanted) else {
            panic!("PLANISH_READER is \"{wanted}\", not one of {}", names.join(", "));
        };
        readers::prepare();
        READER.set(found.1).expect("initialised once");
    },
    |bytes: &[u8]| {
        let started = Instant::now();
        (READER.get().expect("initialised"))(bytes);
        let us = started.elapsed().as_micros() as u64;
        if us > SLOWEST_US.fetch_max(us, Ordering::Relaxed) {
            eprintln!("slowest {:.1} ms, {} bytes", us as f64 / 1e3, bytes.len());
        }
    }
);
