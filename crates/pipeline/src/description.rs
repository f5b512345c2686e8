//! A pipeline as data for other programs: its settings with their types, units, defaults and sentences.

use serde::{Deserialize, Serialize};

use crate::{
    definition::Setting,
    kind::{Kind, unit},
};

/// A pipeline as `planish show PIPELINE --json` prints it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PipelineDescription {
    /// Name of the pipeline, such as `raster`.
    pub pipeline: String,
    /// Sentence that says what the pipeline does.
    pub title: String,
    /// Prefix of the path of `fixtures/`, with a slash at its end; empty if that folder is in the working directory.
    pub folder: String,
    /// Names of the simulated mirrors, such as `coupon`.
    pub fixtures: Vec<String>,
    /// Names of the machines of `fixtures/machines/`, such as `ion-beam`.
    pub machines: Vec<String>,
    /// Settings that a user can give.
    pub settings: Vec<SettingDescription>,
}

/// A setting of a pipeline as data.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SettingDescription {
    /// Name of the setting, which ends with its unit.
    pub name: String,
    /// Unit of the values; empty if they have none.
    pub unit: String,
    /// Default, after its conditions are resolved; empty if there is none.
    pub default: String,
    /// Phrase of the allowed values, such as `a number above 0`.
    pub allowed: String,
    /// Words that the setting can have; empty if it takes other values.
    pub words: Vec<String>,
    /// True if the value is a number or one of the words, so that it names no file.
    pub is_plain: bool,
    /// Description of the setting for the user.
    pub help: String,
}

impl SettingDescription {
    /// Returns `setting` as data, with its default after the conditions.
    pub fn new(setting: &Setting, default: String) -> Self {
        let words = match &setting.kind {
            Kind::OneOf { words, number: false } => words.clone(),
            _ => vec![],
        };
        Self {
            name: setting.name.clone(),
            unit: unit(&setting.name).into(),
            default,
            allowed: setting.kind.wanted(),
            words,
            is_plain: setting.kind.is_plain(),
            help: setting.help.clone(),
        }
    }
}
