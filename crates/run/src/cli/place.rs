//! Folders of Planish: where its pipelines, fixtures and programs are, and the working directory of the user.

use std::{
    env, fs,
    path::{Component, Path, PathBuf},
};

use planish_handoff::{Failure, Inputs, words};
use planish_pipeline::{
    definition::{DIRECTORY_NAME, Definition, SHARED},
    scope::Scope,
};
use planish_types::Kinematics;

/// Pipelines that end without a plan to execute, so that the commands for several runs refuse them.
const NO_PLANS: [&str; 1] = ["compare-dwell"];

/// Folders of an installed Planish or of a clone of its repository, and the working directory of the user.
pub struct Installation {
    /// Folder with `pipelines/` and `fixtures/`.
    root: PathBuf,
    /// Folder that contains the programs.
    pub programs: PathBuf,
    /// Working directory of the user.
    here: PathBuf,
}

impl Installation {
    /// Finds the folders. PLANISH_SHARE and PLANISH_PROGRAMS name them for an installed Planish. In a clone, the pipelines
    /// are above the program, and the other programs are beside it.
    ///
    /// # Errors
    /// Fails if PLANISH_SHARE is not set and no folder above the program has pipelines.
    pub fn find() -> Result<Self, Failure> {
        let [share, programs] = ["PLANISH_SHARE", "PLANISH_PROGRAMS"]
            .map(|name| env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from));
        let program = env::current_exe()?;
        let beside = program.parent().unwrap_or(Path::new(".")).to_path_buf();
        let shared = format!("pipelines/{SHARED}.yaml");
        let above = program.ancestors().find(|folder| folder.join(&shared).is_file());
        let root = share.or(above.map(Path::to_path_buf)).ok_or_else(|| {
            Failure::new(format!(
                "there is no pipelines/{SHARED}.yaml above {}; set PLANISH_SHARE to the folder with pipelines/ and \
                 fixtures/",
                program.display()
            ))
        })?;
        Ok(Self {
            root: root.canonicalize().unwrap_or(root),
            programs: programs.unwrap_or(beside),
            here: env::current_dir()?,
        })
    }

    /// Returns the prefix for paths in the folder of the pipelines, with a slash at its end. It is empty if that is the
    /// working directory.
    pub fn repository(&self) -> String {
        if self.root == self.here { String::new() } else { format!("{}/", self.root.display()) }
    }

    /// Returns the script that makes all plans of a sweep. Only a clone of the repository has it.
    pub fn workflow(&self) -> PathBuf {
        self.root.join("workflow/sweep.sh")
    }

    /// Returns the names of the pipelines, in alphabetical order.
    pub fn pipelines(&self) -> Vec<String> {
        let mut names = self.names("pipelines", "yaml");
        names.retain(|name| name != SHARED);
        names
    }

    /// Returns the names of the fixtures (simulated mirrors), in alphabetical order.
    pub fn fixtures(&self) -> Vec<String> {
        self.names("fixtures", "json")
    }

    /// Returns the names of the machines of the fixtures, in alphabetical order.
    pub fn machines(&self) -> Vec<String> {
        self.names("fixtures/machines", "json")
    }

    /// Returns the names of the files with this ending in a folder, without the ending, in alphabetical order. An
    /// absent folder counts as empty.
    fn names(&self, folder: &str, ending: &str) -> Vec<String> {
        let entries = fs::read_dir(self.root.join(folder)).into_iter().flatten().flatten();
        let files = entries
            .map(|entry| entry.path())
            .filter(|p| p.extension().is_some_and(|e| e == ending));
        let mut names: Vec<String> =
            files.filter_map(|p| Some(p.file_stem()?.to_string_lossy().into_owned())).collect();
        names.sort();
        names
    }

    /// Reads the definition of a pipeline from its file in `pipelines/`.
    ///
    /// # Errors
    /// Refuses an unknown name, and a file that cannot be read or is no definition.
    pub fn definition(&self, name: &str) -> Result<Definition, Failure> {
        let all = self.pipelines();
        if !all.iter().any(|known| known == name) {
            return Err(Failure::new(format!(
                "no pipeline '{name}'; there are: {}",
                all.join(" ")
            )));
        }
        let [shared, own] = [SHARED, name].map(|name| {
            let path = self.root.join("pipelines").join(format!("{name}.yaml"));
            fs::read_to_string(&path)
                .map_err(|e| Failure::new(format!("{}: cannot read: {e}", path.display())))
        });
        Definition::read(name, &shared?, &own?).map_err(Failure::new)
    }

    /// Reads the definition of a pipeline that ends with a plan to execute.
    ///
    /// # Errors
    /// Refuses an unknown name and a pipeline without a plan.
    pub fn definition_of_plans(&self, name: &str) -> Result<Definition, Failure> {
        if NO_PLANS.contains(&name) || !self.pipelines().iter().any(|known| known == name) {
            return Err(Failure::new(format!(
                "'{name}' is no pipeline that plans a run; give raster, maze, spiral"
            )));
        }
        self.definition(name)
    }

    /// Returns the settings of a pipeline as the user gave them, with the facts that need no file. They are not checked
    /// together.
    ///
    /// # Errors
    /// Refuses a setting that the pipeline does not have, and a value that it cannot have.
    pub fn settings<'a, S: AsRef<str>>(
        &self,
        definition: &'a Definition,
        settings: &[S],
    ) -> Result<Scope<'a>, Failure> {
        let mut scope = Scope::new(definition, settings).map_err(Failure::new)?;
        let word = |text: String| if text.is_empty() { vec![] } else { vec![text] };
        scope.set("repository", word(self.repository()));
        let surface = scope.text("surface").map_err(Failure::new)?;
        scope.set("surface_name", word(name_of(&self.here.join(surface))));
        let name = scope.text("name").map_err(Failure::new)?;
        scope.set(DIRECTORY_NAME, vec![directory_name(&name)]);
        Ok(scope)
    }

    /// Checks the settings of a pipeline together, and returns them with all facts, such as those of the machine file.
    ///
    /// # Errors
    /// Refuses settings that the pipeline does not take, alone or together, and a machine file that cannot be read.
    pub fn scope<'a, S: AsRef<str>>(
        &self,
        definition: &'a Definition,
        settings: &[S],
    ) -> Result<Scope<'a>, Failure> {
        let mut scope = self.settings(definition, settings)?;
        scope.check().map_err(Failure::new)?;
        let machine = PathBuf::from(scope.text("machine").map_err(Failure::new)?);
        let read = Inputs::new().read_machine(&machine)?;
        scope.set("machine_title", vec![read.name().into()]);
        let kinematics = match read.kinematics() {
            Kinematics::Xy => "xy",
            Kinematics::Xyz => "xyz",
            Kinematics::Tilts { .. } => "xyz-tilts",
            Kinematics::Spindle { .. } => "spindle",
        };
        scope.set("kinematics", vec![kinematics.into()]);
        let file = machine.file_name().unwrap_or_default().to_string_lossy().into_owned();
        scope.set("machine_name", vec![file]);
        for (setting, fact) in [("surface", "surface_kind"), ("tif", "tif_kind")] {
            let path = scope.text(setting).map_err(Failure::new)?;
            scope.set(fact, vec![kind_of(&path).into()]);
        }
        let fixture = scope.text("fixture").map_err(Failure::new)?;
        scope.set("fixture_tool", self.fixture_tool(&fixture)?);
        Ok(scope)
    }

    /// Reads the command, in words, that makes the tool of a fixture from its tool influence function. Without such a
    /// file, the list is empty.
    fn fixture_tool(&self, fixture: &str) -> Result<Vec<String>, Failure> {
        let path = self.root.join("fixtures").join(format!("{fixture}.tool"));
        match fs::read_to_string(&path) {
            Ok(text) => words::split(text.trim())
                .map_err(|e| Failure::new(format!("{}: {e}", path.display()))),
            Err(_) => Ok(vec![]),
        }
    }
}

/// Returns the kind of an input as a pipeline names it. It is `none` for an empty path, `file` if there is no
/// directory, `artifact` for a directory with a manifest or with the weights of a varying tool, and otherwise `bare`
/// (arrays alone).
pub fn kind_of(path: &str) -> &'static str {
    let dir = Path::new(path);
    if path.is_empty() {
        "none"
    } else if !dir.is_dir() {
        "file"
    } else if dir.join("manifest.json").exists() || dir.join("weight.npy").exists() {
        "artifact"
    } else {
        "bare"
    }
}

/// Returns the last name of a path after `..` is resolved, without following links.
pub fn name_of(path: &Path) -> String {
    let mut parts = Vec::new();
    for part in path.components() {
        match part {
            Component::ParentDir => drop(parts.pop()),
            Component::Normal(name) => parts.push(name),
            _ => {}
        }
    }
    parts.last().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
}

/// Returns a text as a name for a directory: every character that is neither a letter, a digit nor one of `._+-`
/// becomes `_`. So does a dot at the beginning; an empty text, or one of dots only, becomes `_`.
pub fn directory_name(name: &str) -> String {
    let characters = name.chars();
    let plain: String = characters
        .map(|c| if c.is_alphanumeric() || "._+-".contains(c) { c } else { '_' })
        .collect();
    match plain.strip_prefix('.') {
        _ if plain.chars().all(|c| c == '.') => "_".into(),
        Some(rest) => format!("_{rest}"),
        None => plain,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn any_name_becomes_that_of_a_directory() {
        for (name, found) in [
            ("coupon", "coupon"),
            ("lines/a b", "lines_a_b"),
            ("", "_"),
            ("..", "_"),
            (".a", "_a"),
            ("Größe 面;$(x)", "Größe_面___x_"),
        ] {
            assert_eq!(directory_name(name), found);
        }
        for (path, name) in [("/a/b/", "b"), ("/a/../c", "c"), ("/a/b/.", "b"), ("/", "")] {
            assert_eq!(name_of(Path::new(path)), name);
        }
    }
}
