//! A run of several stages: the owner of its directory.
//!
//! * [`owner`]: owner of a directory, that is one pipeline for one mirror.
//!
//! The binary reads the pipelines (`planish-pipeline`), locks the directory while their stages run, and names at the end
//! the stages that gave a negative verdict.

pub mod owner;
