//! Definition of a pipeline: its settings, and its stages as commands. `pipelines/shared.yaml` explains the files.
//!
//! * [`node`]: YAML with the line of every value.
//! * [`kind`]: types of settings, which check a value.
//! * [`phrase`]: words with names in braces, and conditions.
//! * [`action`]: lines of a stage.
//! * [`definition`]: reads and checks the two files of a pipeline.
//! * [`scope`]: words that a name stands for.
//! * [`walk`]: the steps of a stage, one by one.
//!
//! Nothing here runs a command or evaluates a text: a step is a program and its arguments.

pub mod action;
pub mod definition;
pub mod kind;
pub mod node;
pub mod phrase;
pub mod scope;
pub mod walk;
