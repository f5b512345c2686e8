//! `planish sweep expand`.

use std::{
    fs::{self, File, OpenOptions, TryLockError},
    path::{Component, Path, PathBuf},
};

use clap::Args;
use planish_handoff::{Failure, Inputs, OutputFile, Status, say, words};
use planish_sweep::{
    description::{Description, Mirror, read},
    expand::expand,
    plan::{Ground, Round, Step, Sweep, hash, steps_of_mirror},
    setting::default,
    varying,
};
use serde_json::{Value, json};

use super::super::files::{VERSION, write_json};

/// Largest size of a sweep's file, bytes: about a thousand blocks. Larger files are refused. Larger: other files
/// given by mistake are read. Smaller: long sweeps are refused.
const LARGEST_FILE_BYTES: u64 = 1 << 20;

/// Endings of the names of instrument files, which are imported into artifacts.
const FILES: [&str; 13] =
    ["dat", "datx", "xyz", "asc", "txt", "csv", "mat", "h5", "hdf5", "fits", "fit", "npy", "sdf"];

#[derive(Args)]
pub struct Expand {
    /// Sweep [YAML]; relative paths in it begin in its folder
    sweep: PathBuf,
    /// Output directory of the sweep
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

impl Expand {
    pub fn run(&self) -> Result<Status, Failure> {
        let path = &self.sweep;
        let mut inputs = Inputs::new();
        let bytes = inputs.read_bytes("sweep", path, LARGEST_FILE_BYTES)?;
        let refused = |problem: String| Failure::new(format!("{}: {problem}", path.display()));
        let text = String::from_utf8(bytes)
            .map_err(|_| refused("is not UTF-8; write it as a text file".into()))?;
        let description = read(&text).map_err(|e| refused(e.to_string()))?;
        let folder = path.parent().unwrap_or(Path::new("."));
        self.refuse_foreign()?;
        let _lock = self.alone()?;
        let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let mut grounds = Grounds { folder, out: &self.out, inputs, copies: vec![] };
        let mut sweep = grounds.sweep(&name, &description)?;
        let commands = grounds.varying(&description, &mut sweep)?;
        let plans = expand(&description.blocks, &sweep.ground).map_err(refused)?;
        sweep.add_varying(&plans, &commands);
        let paths: std::collections::BTreeSet<_> = plans.iter().map(|p| &p.path_id).collect();
        let counts = format!("{} plans on {} tool paths", plans.len(), paths.len());
        sweep.rounds = vec![Round::new(plans)];
        for (copy, bytes) in grounds.copies {
            OutputFile::begin("--out", &copy, true, &grounds.inputs)?.write(&bytes)?;
        }
        write_json(&self.out.join("sweep.json"), &sweep)?;
        say(format!("{name}: {counts} -> {}", self.out.join("sweep.json").display()));
        Ok(Status::Done)
    }

    /// Locks the sweep, if it has the lock file of a workflow: its plans must not be replaced while one runs. Fails if
    /// another process holds the lock. `None` if there is no lock file.
    fn alone(&self) -> Result<Option<File>, Failure> {
        let Ok(lock) = OpenOptions::new().write(true).open(self.out.join("lock")) else {
            return Ok(None);
        };
        match lock.try_lock() {
            Err(TryLockError::WouldBlock) => Err(Failure::new(format!(
                "{} is in use by another just sweep; wait for its end, or give another --out",
                self.out.display()
            ))),
            _ => Ok(Some(lock)),
        }
    }

    /// Refuses an output directory that has files but no `sweep.json`, because the files belong to somebody. It accepts
    /// one whose first entry is `inputs`, which an expansion that was ended leaves.
    fn refuse_foreign(&self) -> Result<(), Failure> {
        let out = &self.out;
        if out.join("sweep.json").exists() {
            return Ok(());
        }
        let first_entry = match fs::read_dir(out) {
            Ok(entries) => entries.flatten().map(|e| e.file_name()).next(),
            Err(_) if !out.exists() => None,
            Err(e) => return Err(Failure::new(format!("{}: cannot read: {e}", out.display()))),
        };
        match first_entry {
            // What the recipe makes before, and what an expansion that was ended leaves.
            None => Ok(()),
            Some(name) if name == "inputs" => Ok(()),
            Some(name) => Err(Failure::new(format!(
                "{} holds {} and no sweep.json: it is not the directory of a sweep; give another --out",
                out.display(),
                name.display()
            ))),
        }
    }
}

/// A mirror and its tool as the sweep makes them. `map` and `tool` are each a path and a hash; `again` are the
/// settings of `planish run` that make the mirror again.
struct MadeMirror {
    steps: Vec<Step>,
    map: (String, String),
    tool: (String, String),
    name: String,
    again: Vec<String>,
}

/// Reader of the files that a sweep depends on: machine, error budget, specification, map and tools.
struct Grounds<'a> {
    folder: &'a Path,
    out: &'a Path,
    inputs: Inputs,
    /// Files to copy into the directory of the sweep: destination and content.
    copies: Vec<(PathBuf, Vec<u8>)>,
}

impl Grounds<'_> {
    fn sweep(&mut self, name: &str, d: &Description) -> Result<Sweep, Failure> {
        let (machine, machine_hash) = self.frozen("machine", &d.machine)?;
        // By the reader of the stages: a mistake is found before the long ones.
        Inputs::new().read_machine(&self.folder.join(&d.machine))?;
        let process = d.process.as_ref().map(|file| self.frozen("process", file)).transpose()?;
        if let Some(file) = &d.process {
            Inputs::new().read_json::<Value>("process", &self.folder.join(file))?;
        }
        let specification = d.specification.as_ref();
        let specification =
            specification.map(|file| self.frozen("specification", file)).transpose()?;
        if let Some(file) = &d.specification {
            Inputs::new().read_json::<Value>("specification", &self.folder.join(file))?;
        }
        let MadeMirror {
            mut steps,
            map: (map, map_hash),
            tool: (tif, tif_hash),
            name: mirror,
            mut again,
        } = self.mirror(d)?;
        let prepare = words::split(&d.prepare)
            .map_err(|e| Failure::new(format!("prepare: {}: {e}", d.prepare)))?;
        let surface_hash = hash(&json!(["surface", map_hash, prepare]));
        let surface = format!("surface/{surface_hash}");
        steps.extend(steps_of_mirror(
            "prepare",
            [("measured", vec![map]), ("prepare", prepare), ("map", vec![surface.clone()])],
        ));
        let mut tools = vec![(String::new(), tif)];
        let mut tool_hashes = vec![(String::new(), tif_hash)];
        for (name, dir) in &d.tools {
            let at = self.existing("tools", dir)?;
            tool_hashes.push((name.clone(), content(&at)?));
            tools.push((name.clone(), text(&at)?));
        }
        if d.prepare != default("prepare") {
            again.push(format!("prepare={}", d.prepare));
        }
        again.push(format!("machine={}", self.plain(&d.machine).display()));
        again.extend(d.process.iter().map(|p| format!("error_budget={}", self.plain(p).display())));
        let plain_specification = d.specification.as_ref().map(|file| self.plain(file));
        again.extend(plain_specification.map(|file| format!("specification={}", file.display())));
        let (process, process_hash) = process.unzip();
        let (specification, specification_hash) = specification.unzip();
        let ground = Ground {
            surface: surface_hash,
            tools: tool_hashes,
            varying: vec![],
            own_varying: None,
            machine: machine_hash,
            process: process_hash,
            specification: specification_hash,
        };
        Ok(Sweep {
            version: VERSION,
            name: name.into(),
            mirror,
            mirror_steps: steps,
            surface,
            tools,
            machine,
            process,
            specification,
            reports: d.reports,
            constraints: d.constraints,
            again,
            ground,
            rounds: vec![],
        })
    }

    /// Returns the words of every command of a tool that varies, by the text of its setting. It adds to the ground of
    /// the plans the hash of each command with the files that it reads. If the fixture has a command, that becomes
    /// the command of all plans without the setting.
    fn varying(
        &mut self,
        d: &Description,
        sweep: &mut Sweep,
    ) -> Result<Vec<(String, Vec<String>)>, Failure> {
        let mut texts: Vec<String> = Vec::new();
        if let Mirror::Fixture(recipe) = &d.mirror
            && let Some(text) = self.command_of_fixture(recipe)?
        {
            sweep.ground.own_varying = Some(text.clone());
            texts.push(text);
        }
        let settings = d.blocks.iter().flat_map(|block| &block.settings);
        for value in settings.filter(|(key, _)| key == "varying").flat_map(|(_, values)| values) {
            let text = value.to_string();
            if text != varying::NONE && !texts.contains(&text) {
                texts.push(text);
            }
        }
        let mut commands = Vec::new();
        for text in texts {
            let words =
                words::split(&text).map_err(|e| Failure::new(format!("varying: {text}: {e}")))?;
            let mut hashes = Vec::new();
            let placed = varying::with_places(words, |path| -> Result<String, Failure> {
                let at = self.existing("varying", path)?;
                hashes.push(content(&at)?);
                self::text(&at)
            })?;
            let digest = hash(&json!(["varying", text, hashes]));
            sweep.ground.varying.push((text.clone(), digest));
            commands.push((text, placed));
        }
        Ok(commands)
    }

    /// Reads the command in the file beside the recipe of a fixture (ending `.tool`); `None` if there is no such
    /// file.
    fn command_of_fixture(&mut self, recipe: &str) -> Result<Option<String>, Failure> {
        let path = self.folder.join(recipe).with_extension("tool");
        if !path.exists() {
            return Ok(None);
        }
        let bytes = self.inputs.read_bytes("fixture-tool", &path, LARGEST_FILE_BYTES)?;
        let text = String::from_utf8(bytes)
            .map_err(|_| Failure::new(format!("{}: is not UTF-8", path.display())))?;
        let text = text.trim().to_string();
        varying::check(&text).map_err(|wanted| {
            Failure::new(format!("{}: is '{text}'; give {wanted}", path.display()))
        })?;
        Ok(Some(text))
    }

    /// Returns the map and the tool of the sweep, with the steps that make them and the settings by which `planish run`
    /// gets them.
    fn mirror(&mut self, d: &Description) -> Result<MadeMirror, Failure> {
        match &d.mirror {
            Mirror::Fixture(recipe) => {
                let (file, digest) = self.frozen("fixture", recipe)?;
                let name = stem(Path::new(recipe));
                let own = format!("mirror/{digest}");
                let names = [("recipe", vec![file]), ("made", vec![own.clone()])];
                let steps = steps_of_mirror("fixture", names);
                let plain = self.plain(recipe);
                let map = format!("{own}/surface");
                let tif = format!("{own}/tif");
                let is_known = plain == Path::new("fixtures").join(format!("{name}.json"));
                // Another tool is given with the map; and a map of one's own has no command that is not given.
                let has_command = self.folder.join(recipe).with_extension("tool").exists();
                let again = if is_known && d.tools.is_empty() && !has_command {
                    vec![format!("fixture={name}")]
                } else {
                    [("surface", &map), ("tif", &tif)]
                        .map(|(key, dir)| format!("{key}={}", self.out.join(dir).display()))
                        .to_vec()
                };
                let map = (map, digest.clone());
                Ok(MadeMirror { steps, map, tool: (tif, digest), name, again })
            }
            Mirror::Measured { surface, tif, surface_settings, tif_settings } => {
                let mut steps = Vec::new();
                let mut made = Vec::new();
                let mut again = Vec::new();
                for (kind, source, settings) in
                    [("surface", surface, surface_settings), ("tif", tif, tif_settings)]
                {
                    let path = self.existing(kind, source)?;
                    again.push(format!("{kind}={}", self.plain(source).display()));
                    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
                    if !extension.is_some_and(|e| FILES.contains(&e.as_str())) {
                        made.push((text(&path)?, content(&path)?));
                        continue;
                    }
                    let flags = words::split(settings)
                        .map_err(|e| Failure::new(format!("{kind}_settings: {settings}: {e}")))?;
                    again.push(format!("{kind}_settings={settings}"));
                    let digest = hash(&json!([kind, content(&path)?, flags]));
                    let out = format!("mirror/{digest}");
                    let settings = format!("{kind}_settings");
                    let imported = format!("imported_{kind}");
                    let names = [
                        (kind, vec![text(&path)?]),
                        (settings.as_str(), flags),
                        (imported.as_str(), vec![out.clone()]),
                    ];
                    steps.extend(steps_of_mirror(&format!("import-{kind}"), names));
                    made.push((out, digest));
                }
                let [map, tool] = <[_; 2]>::try_from(made).expect("a map and a tool");
                Ok(MadeMirror { steps, map, tool, name: stem(Path::new(surface)), again })
            }
        }
    }

    /// Copies a file of the user into the directory of the sweep, so that all jobs read the same content. Returns the
    /// path of the copy in the sweep and the first 12 digits of its hash. `role` names the file in messages.
    fn frozen(&mut self, role: &str, file: &str) -> Result<(String, String), Failure> {
        let path = self.folder.join(file);
        let bytes = self
            .inputs
            .read_bytes(role, &path, LARGEST_FILE_BYTES)
            .map_err(|e| Failure::new(format!("{role}: {e}")))?;
        let digest = blake3::hash(&bytes).to_hex()[..12].to_string();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let copy = format!("inputs/{digest}/{name}");
        self.copies.push((self.out.join(&copy), bytes));
        Ok((copy, digest))
    }

    /// Returns the absolute path of an existing input. `path` starts in the folder of the sweep's file, and `role`
    /// names the input in messages.
    fn existing(&self, role: &str, path: &str) -> Result<PathBuf, Failure> {
        let path = self.folder.join(path);
        path.canonicalize().map_err(|e| {
            let remedy = "give a directory or a file, from the folder of the sweep's file";
            Failure::new(format!("{role} {}: cannot read: {e}; {remedy}", path.display()))
        })
    }

    /// Returns `path`, which starts in the folder of the sweep's file, as a path from the directory in which the user
    /// started the sweep.
    fn plain(&self, path: &str) -> PathBuf {
        let mut plain = PathBuf::new();
        for part in self.folder.join(path).components() {
            match part {
                Component::CurDir => {}
                Component::ParentDir
                    if matches!(plain.components().next_back(), Some(Component::Normal(_))) =>
                {
                    plain.pop();
                }
                part => plain.push(part),
            }
        }
        plain
    }
}

/// Returns the first 12 digits of the hash of a file, or of the files directly in a directory: names and contents.
fn content(path: &Path) -> Result<String, Failure> {
    let unreadable = |e: std::io::Error| super::super::files::unreadable(path, &e);
    let mut hasher = blake3::Hasher::new();
    let mut files = vec![path.to_path_buf()];
    if path.is_dir() {
        let entries = fs::read_dir(path).map_err(unreadable)?;
        let entries = entries.map(|entry| entry.map(|e| e.path())).collect::<Result<Vec<_>, _>>();
        files = entries.map_err(unreadable)?;
        files.retain(|file| file.is_file());
        files.sort();
    }
    for file in &files {
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        let mut open = File::open(file).map_err(unreadable)?;
        hasher.update(format!("{}:{name}:", name.len()).as_bytes());
        let before = hasher.count();
        std::io::copy(&mut open, &mut hasher).map_err(unreadable)?;
        let length = hasher.count() - before;
        hasher.update(&length.to_le_bytes());
    }
    Ok(hasher.finalize().to_hex()[..12].to_string())
}

fn stem(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

fn text(path: &Path) -> Result<String, Failure> {
    let text = path.to_str().map(String::from);
    text.ok_or_else(|| Failure::new(format!("{}: is not UTF-8; give another name", path.display())))
}
