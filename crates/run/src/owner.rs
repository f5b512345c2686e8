//! Owner of the directory of a run: the pipeline and the mirror that the directory belongs to.

use serde::{Deserialize, Serialize};

/// Owner of a directory, as its file `run.json` states it. Another pipeline or mirror is refused there.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Owner {
    /// Name of the pipeline, such as `raster`.
    pub pipeline: String,
    /// Mirror that the run is for.
    pub mirror: Mirror,
}

/// Mirror that a run is for: a simulated one or a measured one.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Mirror {
    /// Simulated mirror of the folder `fixtures/`, by the name of its recipe.
    Fixture(String),
    /// Measured mirror: a surface error map and a tool influence function, by their absolute paths. Two mirrors may
    /// have the same file name.
    Measured {
        /// Absolute path of the surface error map.
        surface: String,
        /// Absolute path of the tool influence function.
        tif: String,
    },
}

impl Owner {
    /// Returns the pipeline and the mirror as text for messages, such as `pipeline raster, fixture coupon`.
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
