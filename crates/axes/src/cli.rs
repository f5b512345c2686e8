//! Subcommands, one file each.

mod contact;
mod motion;

use std::path::PathBuf;

use clap::Subcommand;
use planish_form::{Form, FormFile};
use planish_handoff::{Failure, Inputs, Status};

#[derive(Subcommand)]
pub enum AxesCommand {
    /// Motion of all axes while the contact point follows a plan
    ///
    /// Every axis runs cubics between nodes at which its position and velocity are exact. Where an axis would exceed a
    /// limit, the motion is slowed down there, and the program says how much longer the tool removes.
    Motion(motion::MotionCommand),
    /// Contact point that a motion of the axes executes, for planish simulate
    Contact(contact::Contact),
}

impl AxesCommand {
    pub fn run(&self) -> Result<Status, Failure> {
        match self {
            Self::Motion(arguments) => arguments.run(),
            Self::Contact(arguments) => arguments.run(),
        }
    }
}

/// Returns the form of the part that `--form` names, or a plane if the flag is absent.
fn read_form(form: Option<&PathBuf>, inputs: &mut Inputs) -> Result<Form, Failure> {
    Ok(match form {
        Some(path) => inputs.read_form("form", path)?.form,
        None => Form::new(&FormFile::plane(), None)?,
    })
}
