//! Owner of the directory of a run: one pipeline for one mirror.

use serde::{Deserialize, Serialize};

/// Content of `run.json` in the directory of a run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Owner {
    /// Name of the pipeline.
    pub pipeline: String,
    /// The mirror.
    pub mirror: Mirror,
}

/// The mirror of a run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Mirror {
    /// One of the fixtures, by its name.
    Fixture(String),
    /// A map and a tool, by their absolute paths: two mirrors may have the same file name.
    Measured {
        /// The surface error map.
        surface: String,
        /// The tool influence function.
        tif: String,
    },
}

impl Owner {
    /// Description in words, for messages.
    pub fn describe(&self) -> String {
        let Self { pipeline, mirror } = self;
        match mirror {
            Mirror::Fixture(name) => format!("pipeline {pipeline}, fixture {name}"),
            Mirror::Measured { surface, tif } => {
                format!("pipeline {pipeline}, surface {surface}, tif {tif}")
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn run_json_has_this_layout() {
        let fixture = r#"{ "pipeline": "raster", "mirror": { "fixture": "coupon" } }"#;
        let measured =
            r#"{ "pipeline": "maze", "mirror": { "measured": { "surface": "/m", "tif": "/t" } } }"#;
        for (text, owner) in [
            (
                fixture,
                Owner { pipeline: "raster".into(), mirror: Mirror::Fixture("coupon".into()) },
            ),
            (
                measured,
                Owner {
                    pipeline: "maze".into(),
                    mirror: Mirror::Measured { surface: "/m".into(), tif: "/t".into() },
                },
            ),
        ] {
            assert_eq!(serde_json::from_str::<Owner>(text).unwrap(), owner);
        }
        assert!(serde_json::from_str::<Owner>(r#"{ "pipeline": "raster" }"#).is_err());
    }
}
