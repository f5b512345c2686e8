//! Definition of a pipeline: its settings, and its stages, which are lists of commands. `pipelines/shared.yaml`
//! explains the format of the definition files.
//!
//! * [`node`]: YAML values with the line number of each.
//! * [`kind`]: types of settings, which check a value.
//! * [`phrase`]: texts with names in braces, and conditions.
//! * [`action`]: lines of a stage: commands, and calls of other stages.
//! * [`definition`]: reads and checks the two files of a pipeline.
//! * [`description`]: a pipeline as data for other programs.
//! * [`scope`]: words that a name in braces stands for.
//! * [`walk`]: the steps of a stage, one by one.
//!
//! Nothing here runs a command or evaluates a text: a step is a program and its arguments.

pub mod action;
pub mod definition;
pub mod description;
pub mod kind;
pub mod node;
pub mod phrase;
pub mod scope;
pub mod walk;
