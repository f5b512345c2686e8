//! What a run of several stages needs beside the stages.
//!
//! * [`owner`]: whose directory it is: a pipeline's, for one mirror.
//!
//! The binary holds the directory while the stages run, and says at the end which of them gave a
//! negative verdict.

pub mod owner;
