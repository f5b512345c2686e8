//! `planish app`: a page in the browser that plans by the programs that exist.
//!
//! * [`guard`]: decides which request is answered.
//! * [`after`]: the step after the run.
//! * [`choice`]: what the user chose in a step, and the command lines that do it.
//! * [`session`]: all steps, as the file of a session holds them.
//! * [`refusal`]: a request that is not answered, and why.
//!
//! The binary listens on the loopback interface, keeps the files of a session, and runs the command lines.

// The command line names this library as any other program does.
extern crate self as planish_app;

pub mod after;
pub mod choice;
mod cli;
pub mod command;
pub mod guard;
pub mod refusal;
pub mod session;
