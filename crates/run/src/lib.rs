//! Tools for a run of several stages: the lock of its directory, its owner, and its verdict.
//!
//! * [`owner`]: owner of a directory, that is one pipeline for one mirror.
//!
//! The binary locks the directory while the stages run, and names at the end the stages that gave a
//! negative verdict.

pub mod owner;
