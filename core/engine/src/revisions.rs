//! Model files with history: every change makes a revision with a parent, and no revision is ever lost.
//!
//! `MODEL.toml` is the newest revision. Every revision that a command made or left behind lies beside it, immutable, as
//! `MODEL.history/REVISION.toml`. Text is edited in place, so comments and formatting stay. The history is written
//! before the file, and the file by a rename: a kill at any instruction leaves the old file or the new one, and both
//! revisions once they were current. `MODEL.toml.lock` holds the new text until it takes the file's name, and keeps a
//! second writer out.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io::{ErrorKind, Write as _};
use std::path::{Path, PathBuf};

use serde::Serialize;
use toml_edit::{ArrayOfTables, DocumentMut, InlineTable, Item, Table, TableLike, Value, value};

use crate::config::{ConfigError, EffectEntry, Model};
use dragfree_archive::files::{IoContext as _, IoError, Problem, folder_of, sync_folder};

/// Why a model file could not be changed or its history not be read.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "every field is named in its sentence")]
pub enum RevisionError {
    /// The file is no model.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The operating system refused something.
    #[error(transparent)]
    Io(#[from] IoError),
    /// Another writer is at work, or was killed.
    #[error(
        "{} exists: another command is changing the model file; try again when it is done. If none is, it was killed: \
         remove that file, the model file itself is whole", path.display()
    )]
    Locked { path: PathBuf },
    /// The file was written between reading and replacing it.
    #[error("{} was changed by someone else meanwhile; nothing was done, run the command again", path.display())]
    Changed { path: PathBuf },
    /// A revision cannot name a file.
    #[error(
        "{}: revision {revision:?} cannot name a file of the history: letters, digits, '.', '_', '+' and '-' may stand in it, no \
         '.' first; change it in the file", path.display()
    )]
    Name { path: PathBuf, revision: String },
    /// The effects are written in a way that cannot be edited.
    #[error("{}: `effect` is not a list of [[effect]] tables; write them so", path.display())]
    Shape { path: PathBuf },
    /// The effect is in the model already.
    #[error("{}: effect {effect} is in the model already; `dragfree model remove` takes it out", path.display())]
    There { path: PathBuf, effect: String },
    /// The effect is not in the model, or not exactly once.
    #[error("{}: {what}; the model has {known}", path.display())]
    NoEffect { path: PathBuf, what: String, known: String },
    /// No such revision.
    #[error("no revision {revision} of {}; there are {known}", path.display())]
    NoRevision { path: PathBuf, revision: String, known: String },
    /// A file of the history is not what it was.
    #[error("{}: {reason}; a revision is never changed: take the file from a backup, or remove it", path.display())]
    Damaged { path: PathBuf, reason: String },
    /// A coefficient cannot be fixed.
    #[error("{}: {what}", path.display())]
    Fix { path: PathBuf, what: String },
}

/// What differs between two revisions of one effect.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum What {
    /// It is new.
    Added,
    /// It is gone.
    Removed,
    /// These keys differ: `estimate`, `isolate`, `prior`, `parameters`, `order`.
    Changed(Vec<&'static str>),
}

/// A difference between two revisions.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Change {
    /// `ID:INSTANCE`.
    pub effect: String,
    /// What happened to it.
    pub what: What,
}

/// What turned the effects `old` into `new`.
pub fn changes(old: &[EffectEntry], new: &[EffectEntry]) -> Vec<Change> {
    let same = |a: &EffectEntry, b: &EffectEntry| a.id == b.id && a.instance == b.instance;
    let mut out = Vec::new();
    let mut put = |entry: &EffectEntry, what| out.push(Change { effect: entry.to_string(), what });
    for entry in old.iter().filter(|o| !new.iter().any(|n| same(o, n))) {
        put(entry, What::Removed);
    }
    let kept_before: Vec<&EffectEntry> = old.iter().filter(|o| new.iter().any(|n| same(o, n))).collect();
    let mut place = 0;
    for entry in new {
        let Some(before) = old.iter().find(|o| same(o, entry)) else {
            put(entry, What::Added);
            continue;
        };
        let moved = !same(kept_before[place], entry);
        place += 1;
        let keys = [
            ("estimate", before.estimate != entry.estimate),
            ("isolate", before.isolate != entry.isolate),
            ("prior", before.prior != entry.prior),
            ("parameters", before.parameters != entry.parameters),
            ("order", moved),
        ];
        let keys: Vec<&str> = keys.into_iter().filter_map(|(key, differs)| differs.then_some(key)).collect();
        if !keys.is_empty() {
            put(entry, What::Changed(keys));
        }
    }
    out
}

/// A change that was made.
#[derive(Clone, Debug)]
pub struct Committed {
    /// The file.
    pub path: PathBuf,
    /// Revision that was found; `None` for a new file.
    pub before: Option<String>,
    /// Revision made of what somebody had edited by hand.
    pub recorded: Option<String>,
    /// Revision that the file is now.
    pub revision: String,
    /// Its parent.
    pub parent: Option<String>,
    /// What changed from the parent.
    pub changes: Vec<Change>,
    /// Folder of the history.
    pub history: PathBuf,
}

/// A change in the making; dropped without a commit it leaves nothing behind.
#[derive(Debug)]
pub struct Edit {
    path: PathBuf,
    lock: Lock,
    /// Text and model as found; `None` where there is no file yet.
    found: Option<(String, Model)>,
    document: DocumentMut,
    /// Parent and its effects in place of the revision found.
    parent: Option<(String, Vec<EffectEntry>)>,
}

impl Edit {
    /// Locks and reads a model file.
    ///
    /// # Errors
    /// [`RevisionError`]: it cannot be read, is no model, is read-only, or another writer has it.
    pub fn begin(path: &Path) -> Result<Self, RevisionError> {
        let path = fs::canonicalize(path).at("read the model file", path)?;
        let lock = Lock::take(&path)?;
        let text = fs::read_to_string(&path).at("read the model file", &path)?;
        let model = Model::parse(&path, &text)?;
        file_name(&model)?;
        let document = document(&path, &text)?;
        Ok(Self { path, lock, found: Some((text, model)), document, parent: None })
    }

    /// Locks a model file that need not exist, to be filled by [`Edit::fix`].
    ///
    /// # Errors
    /// As [`Edit::begin`].
    pub fn begin_or_new(path: &Path) -> Result<Self, RevisionError> {
        if path.exists() {
            return Self::begin(path);
        }
        let lock = Lock::take(path)?;
        Ok(Self { path: path.to_owned(), lock, found: None, document: DocumentMut::new(), parent: None })
    }

    /// The model as it was found.
    pub fn model(&self) -> Option<&Model> {
        self.found.as_ref().map(|(_, model)| model)
    }

    /// Adds an effect at the end, under `comment` where there is one.
    ///
    /// # Errors
    /// It is there already.
    pub fn add(&mut self, entry: &EffectEntry, comment: &str) -> Result<(), RevisionError> {
        if self.effects()?.iter().any(|e| e.id == entry.id && e.instance == entry.instance) {
            return Err(RevisionError::There { path: self.path.clone(), effect: entry.to_string() });
        }
        let mut table = Table::new();
        table.insert("id", value(&entry.id));
        if !entry.instance.is_empty() {
            table.insert("instance", value(&entry.instance));
        }
        table.insert("estimate", value(entry.estimate));
        if entry.isolate {
            table.insert("isolate", value(true));
        }
        if !entry.parameters.is_empty() {
            let text = toml::Value::Table(entry.parameters.clone()).to_string();
            let parameters: Value = text.parse().map_err(|_| RevisionError::Shape { path: self.path.clone() })?;
            table.insert("parameters", Item::Value(parameters));
        }
        for (name, prior) in &entry.prior {
            let numbers =
                [("value", prior.value), ("sigma", prior.sigma), ("lower", prior.lower), ("upper", prior.upper)];
            for (key, number) in numbers.into_iter().filter_map(|(key, number)| Some((key, number?))) {
                set_prior(&mut table, name, key, number);
            }
        }
        let comment = if comment.is_empty() { String::new() } else { format!("# {comment}\n") };
        table.decor_mut().set_prefix(format!("\n{comment}"));
        self.tables()?.push(table);
        Ok(())
    }

    /// Removes an effect; without an instance the only one of that id.
    ///
    /// # Errors
    /// It is not there, or not alone.
    pub fn remove(&mut self, id: &str, instance: Option<&str>) -> Result<(), RevisionError> {
        let effects = self.effects()?;
        let wanted = |e: &EffectEntry| e.id == id && instance.is_none_or(|i| e.instance == i);
        let at: Vec<usize> = (0..effects.len()).filter(|i| wanted(&effects[*i])).collect();
        let [at] = at[..] else {
            let name = instance.map_or_else(|| id.to_owned(), |i| format!("{id}:{i}"));
            let what = if at.is_empty() {
                format!("effect {name} is not in the model")
            } else {
                format!("effect {name} is in the model {} times: name the instance", at.len())
            };
            let known: Vec<String> = effects.iter().map(ToString::to_string).collect();
            let known = if known.is_empty() { "no effect".to_owned() } else { known.join(", ") };
            return Err(RevisionError::NoEffect { path: self.path.clone(), what, known });
        };
        let tables = self.tables()?;
        let above = detached(tables.get(at));
        tables.remove(at);
        if !above.is_empty() {
            if let Some(next) = tables.get_mut(at) {
                let own = prefix(next);
                next.decor_mut().set_prefix(format!("{above}{own}"));
            } else {
                let own = self.document.trailing().as_str().unwrap_or_default().to_owned();
                self.document.set_trailing(format!("{above}{own}"));
            }
        }
        Ok(())
    }

    /// Takes the text of an earlier revision.
    ///
    /// # Errors
    /// There is none of that name, or it is damaged.
    pub fn restore(&mut self, revision: &str) -> Result<(), RevisionError> {
        let (_, text) = find(&self.path, revision)?;
        self.document = document(&self.path, &text)?;
        Ok(())
    }

    /// Becomes a child of the revision `base` of the model file `source` in which every estimated effect but those of
    /// `keep` (by id, or `ID:INSTANCE`) is fixed at `values`, coefficients by name in SI units, of the product `from`.
    ///
    /// # Errors
    /// No such revision; an effect has no value, or two of its coefficients end alike.
    pub fn fix(
        &mut self,
        source: &Path,
        base: &str,
        (from, values): (&str, &[(String, f64)]),
        keep: &[String],
    ) -> Result<(), RevisionError> {
        let (model, text) = find(source, base)?;
        let refuse = |what: String| RevisionError::Fix { path: source.to_owned(), what };
        let named = |e: &EffectEntry, name: &String| *name == e.id || *name == e.to_string();
        if let Some(unknown) = keep.iter().find(|k| !model.effects.iter().any(|e| named(e, k))) {
            let known: Vec<String> = model.effects.iter().map(ToString::to_string).collect();
            return Err(refuse(format!(
                "effect {unknown} is not in the model, so it cannot be kept; it has {}",
                known.join(", ")
            )));
        }
        self.document = document(source, &text)?;
        if let Some(header) = self.document.get_mut("model").and_then(Item::as_table_like_mut) {
            set(header, "fixed_from", from.into());
        }
        self.parent = Some((model.identity().0, model.effects.clone()));
        let fixed: Vec<bool> =
            model.effects.iter().map(|e| e.estimate && !keep.iter().any(|name| named(e, name))).collect();
        let tables = self.tables()?;
        for ((entry, table), _) in model.effects.iter().zip(tables.iter_mut()).zip(&fixed).filter(|(_, fixed)| **fixed)
        {
            table.insert("estimate", value(false));
            let mut names = BTreeSet::new();
            for (name, number) in values.iter().filter(|(name, _)| entry.owns(name)) {
                let short = name.rsplit('.').next().unwrap_or_default();
                if !names.insert(short) {
                    return Err(refuse(format!(
                        "effect {entry}: two coefficients end in .{short}, so a model file cannot tell them apart; keep it with --keep {entry}"
                    )));
                }
                if !number.is_finite() {
                    return Err(refuse(format!(
                        "coefficient {name} has no value in the product; keep its effect with --keep {entry}"
                    )));
                }
                set_prior(table, short, "value", *number);
            }
            if names.is_empty() {
                return Err(refuse(format!(
                    "the product has no coefficient of effect {entry}; is it a product of this model? Or keep it with --keep {entry}"
                )));
            }
        }
        Ok(())
    }

    /// Makes a revision of the change and of what was edited by hand before it. Without either it is refused by `None`.
    ///
    /// # Errors
    /// [`RevisionError`]; the file is then what it was.
    pub fn commit(self) -> Result<Option<Committed>, RevisionError> {
        let Some((steps, committed)) = self.plan()? else { return Ok(None) };
        let Self { lock, found, path, .. } = self;
        let now = fs::read_to_string(&path).ok();
        if now != found.map(|(text, _)| text) {
            return Err(RevisionError::Changed { path });
        }
        let mut lock = Some(lock);
        for step in steps {
            step.take(&mut lock)?;
        }
        Ok(Some(committed))
    }

    /// What will be written, in order, and what will have come of it.
    fn plan(&self) -> Result<Option<(Vec<Step>, Committed)>, RevisionError> {
        let folder = history_folder(&self.path);
        let kept = history(&folder)?;
        let names = kept.models.iter().map(|(model, _)| model.revision.as_str());
        let names = names
            .chain(self.model().map(|m| m.revision.as_str()))
            .chain(self.parent.as_ref().map(|(name, _)| name.as_str()));
        let mut next = names.map(|name| Model::counter(name).unwrap_or(1)).max().unwrap_or(0).saturating_add(1);

        let mut steps = Vec::new();
        let mut recorded = None;
        let mut parent = None;
        if let Some((text, found)) = &self.found {
            let stored = kept.models.iter().find(|(model, _)| model.revision == found.revision).map(|(model, _)| model);
            if found.edited_by_hand() || stored.is_some_and(|s| s.effects != found.effects) {
                let name = found.name(next);
                next = next.saturating_add(1);
                let text = with_header(document(&self.path, text)?, &name, Some(&found.revision));
                steps.push(Step::Keep { path: folder.join(format!("{name}.toml")), text });
                recorded = Some(name.clone());
                parent = Some(name);
            } else {
                if stored.is_none() {
                    let path = folder.join(format!("{}.toml", found.revision));
                    steps.push(Step::Keep { path, text: text.clone() });
                }
                parent = Some(found.revision.clone());
            }
        }
        let effects = self.effects()?;
        let before = self.model().map(|m| m.effects.clone()).unwrap_or_default();
        let unchanged = self.parent.is_none() && self.found.is_some() && effects == before;
        let revision = match (&recorded, unchanged) {
            (None, true) => return Ok(None),
            (Some(name), true) => name.clone(),
            (_, false) => self.as_model()?.name(next),
        };
        if unchanged {
            parent = self.model().map(|m| m.revision.clone());
        } else if let Some((name, _)) = &self.parent {
            parent = Some(name.clone());
        }
        let text = with_header(self.document.clone(), &revision, parent.as_deref());
        let compared = match (&self.parent, unchanged) {
            (_, true) => {
                kept.models.iter().find(|(m, _)| Some(&m.revision) == parent.as_ref()).map(|(m, _)| m.effects.clone())
            }
            (Some((_, effects)), _) => Some(effects.clone()),
            (None, _) => Some(before),
        };
        if !unchanged {
            steps.push(Step::Keep { path: folder.join(format!("{revision}.toml")), text: text.clone() });
        }
        steps.push(Step::Replace { path: self.path.clone(), text });
        let committed = Committed {
            path: self.path.clone(),
            before: self.model().map(|m| m.revision.clone()),
            recorded,
            revision,
            parent,
            changes: changes(&compared.unwrap_or_default(), &effects),
            history: folder,
        };
        Ok(Some((steps, committed)))
    }

    fn as_model(&self) -> Result<Model, RevisionError> {
        Ok(Model::parse(&self.path, &with_header(self.document.clone(), "0", None))?)
    }

    fn effects(&self) -> Result<Vec<EffectEntry>, RevisionError> {
        Ok(self.as_model()?.effects)
    }

    fn tables(&mut self) -> Result<&mut ArrayOfTables, RevisionError> {
        let path = &self.path;
        self.document
            .entry("effect")
            .or_insert_with(|| Item::ArrayOfTables(ArrayOfTables::new()))
            .as_array_of_tables_mut()
            .ok_or_else(|| RevisionError::Shape { path: path.clone() })
    }
}

/// One act of a commit; whatever comes after it may not happen.
#[derive(Debug)]
enum Step {
    /// A revision goes into the history.
    Keep { path: PathBuf, text: String },
    /// The file becomes the new revision.
    Replace { path: PathBuf, text: String },
}

impl Step {
    fn take(self, lock: &mut Option<Lock>) -> Result<(), RevisionError> {
        match self {
            Self::Keep { path, text } => keep(&path, &text),
            Self::Replace { path, text } => lock.take().map_or(Ok(()), |lock| lock.replace(&path, &text)),
        }
    }
}

/// Writes a file of the history: whole under its name, or not at all, and read-only.
fn keep(path: &Path, text: &str) -> Result<(), RevisionError> {
    if path.exists() {
        let reason = "a revision of that name exists already, and is another".to_owned();
        return Err(RevisionError::Damaged { path: path.to_owned(), reason });
    }
    let write = || {
        let folder = folder_of(path);
        fs::create_dir_all(folder)?;
        let partial = folder.join(format!(".{}.partial", path.file_stem().unwrap_or_default().to_string_lossy()));
        // We hold the lock, so this file is what a kill left. It may be read-only already.
        match fs::remove_file(&partial) {
            Err(error) if error.kind() != ErrorKind::NotFound => return Err(error),
            _ => {}
        }
        let mut file = File::create(&partial)?;
        file.write_all(text.as_bytes())?;
        let mut permissions = file.metadata()?.permissions();
        permissions.set_readonly(true);
        file.set_permissions(permissions)?;
        file.sync_all()?;
        fs::rename(&partial, path)?;
        sync_folder(folder)?;
        // The folder may be new itself.
        sync_folder(folder_of(folder))
    };
    Ok(write().at("write the history", path)?)
}

/// The right to change a model file: `MODEL.toml.lock`, which only one writer can make.
#[derive(Debug)]
struct Lock {
    path: PathBuf,
    file: File,
    renamed: bool,
}

impl Lock {
    fn take(model: &Path) -> Result<Self, RevisionError> {
        let mut path = model.as_os_str().to_owned();
        path.push(".lock");
        let path = PathBuf::from(path);
        if fs::metadata(model).is_ok_and(|m| m.permissions().readonly()) {
            let source = ErrorKind::PermissionDenied.into();
            return Err(IoError { action: "change the read-only", path: model.to_owned(), source }.into());
        }
        match File::create_new(&path) {
            Err(error) if error.kind() == ErrorKind::AlreadyExists => Err(RevisionError::Locked { path }),
            made => Ok(Self { file: made.at("lock the model file with", &path)?, path, renamed: false }),
        }
    }

    /// Fills the lock with the text and gives it the file's name, which also ends the lock.
    fn replace(mut self, path: &Path, text: &str) -> Result<(), RevisionError> {
        let mut write = || {
            self.file.write_all(text.as_bytes())?;
            if let Ok(old) = fs::metadata(path) {
                self.file.set_permissions(old.permissions())?;
            }
            self.file.sync_all()?;
            fs::rename(&self.path, path)?;
            self.renamed = true;
            sync_folder(folder_of(path))
        };
        Ok(write().at("write the model file", path)?)
    }
}

impl Drop for Lock {
    fn drop(&mut self) {
        if !self.renamed {
            let _ = fs::remove_file(&self.path); // one that stays is told to the next writer
        }
    }
}

/// Where a revision stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Place {
    /// The file is this revision.
    Current,
    /// The file came from it.
    Ancestor,
    /// The file did not come from it.
    Aside,
}

/// A revision of a model file.
#[derive(Clone, Debug)]
pub struct Logged {
    /// Its model.
    pub model: Model,
    /// Name; that of [`Model::identity`] where the file was edited by hand.
    pub revision: String,
    /// Parent.
    pub parent: Option<String>,
    /// Where it stands.
    pub place: Place,
    /// What changed from the parent; everything where there is none, nothing where it is not known.
    pub changes: Vec<Change>,
    /// The file was edited by hand after this revision was made, and is not recorded.
    pub edited: bool,
}

/// The revisions of a model file.
#[derive(Clone, Debug)]
pub struct Log {
    /// Newest first.
    pub revisions: Vec<Logged>,
    /// Files of the history that cannot be used, and why.
    pub problems: Vec<Problem>,
}

/// Every revision of a model file.
///
/// # Errors
/// The file itself or the folder of the history cannot be read.
pub fn log(path: &Path) -> Result<Log, RevisionError> {
    let current = Model::load(path)?;
    let kept = history(&history_folder(path))?;
    let stored = kept.models.iter().find(|(model, _)| model.revision == current.revision);
    let edited = current.edited_by_hand() || stored.is_some_and(|(model, _)| model.effects != current.effects);
    let (revision, parent) = match (edited, current.edited_by_hand()) {
        (true, false) => (format!("{}+{}", current.revision, current.digest()), Some(current.revision.clone())),
        _ => current.identity(),
    };
    let logged = |model: Model, revision: String, parent, edited| {
        let (place, changes) = (Place::Aside, Vec::new());
        Logged { model, revision, parent, place, changes, edited }
    };
    let kept_models = kept.models.into_iter().map(|(model, _)| model);
    let mut revisions: Vec<Logged> = kept_models
        .filter(|model| edited || model.revision != current.revision)
        .map(|model| logged(model.clone(), model.revision, model.parent, false))
        .collect();
    revisions.push(logged(current, revision.clone(), parent, edited));
    let number = |r: &Logged| if r.edited { u32::MAX } else { Model::counter(&r.revision).unwrap_or(0) };
    revisions.sort_by_cached_key(|r| Reverse((number(r), r.revision.clone())));
    let effects: BTreeMap<String, Vec<EffectEntry>> =
        revisions.iter().map(|r| (r.revision.clone(), r.model.effects.clone())).collect();
    let mut at = Some(revision.clone());
    while let Some(found) = revisions.iter_mut().find(|r| Some(&r.revision) == at.as_ref() && r.place == Place::Aside) {
        found.place = if found.revision == revision { Place::Current } else { Place::Ancestor };
        at.clone_from(&found.parent);
    }
    for r in &mut revisions {
        let from = r.parent.as_ref().map_or(Some(&[][..]), |parent| effects.get(parent).map(Vec::as_slice));
        r.changes = from.map(|from| changes(from, &r.model.effects)).unwrap_or_default();
    }
    Ok(Log { revisions, problems: kept.problems })
}

/// A revision of a model file and its text: by its name, or by the number in front where that is enough.
///
/// # Errors
/// There is none, or the file cannot be read.
pub fn find(path: &Path, revision: &str) -> Result<(Model, String), RevisionError> {
    let current = Model::load(path)?;
    if current.identity().0 == revision {
        let text = fs::read_to_string(path).at("read the model file", path)?;
        return Ok((Model::parse(path, &text)?, text));
    }
    let kept = history(&history_folder(path))?;
    if let Some(found) = kept.models.iter().find(|(model, _)| model.revision == revision) {
        return Ok(found.clone());
    }
    let numbered: Vec<_> =
        kept.models.iter().filter(|(model, _)| model.revision.starts_with(&format!("{revision}-"))).collect();
    if let [found] = numbered[..] {
        return Ok(found.clone());
    }
    let mut known: Vec<String> = kept.models.into_iter().map(|(model, _)| model.revision).collect();
    let current = current.identity().0;
    if !known.contains(&current) {
        known.push(current);
    }
    Err(RevisionError::NoRevision { path: path.to_owned(), revision: revision.to_owned(), known: known.join(", ") })
}

/// `MODEL.history` beside `MODEL.toml`.
pub fn history_folder(path: &Path) -> PathBuf {
    path.with_extension("history")
}

#[derive(Default)]
struct History {
    /// Sound revisions and their texts, by name.
    models: Vec<(Model, String)>,
    problems: Vec<Problem>,
}

fn history(folder: &Path) -> Result<History, RevisionError> {
    let mut kept = History::default();
    let entries = match fs::read_dir(folder) {
        Ok(entries) => entries,
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(kept),
        other => other.at("read the history", folder)?,
    };
    let mut paths = Vec::new();
    for entry in entries {
        let path = entry.at("read the history", folder)?.path();
        // What a kill left unfinished begins with a dot; it never was a revision.
        if !path.file_name().is_some_and(|name| name.to_string_lossy().starts_with('.')) {
            paths.push(path);
        }
    }
    paths.sort();
    for path in paths {
        match sound(&path) {
            Ok(found) => kept.models.push(found),
            Err(error) => kept.problems.push(Problem { path, reason: error.to_string() }),
        }
    }
    Ok(kept)
}

/// A file of the history, whose name and digest must be its content's.
fn sound(path: &Path) -> Result<(Model, String), RevisionError> {
    let text = fs::read_to_string(path).at("read the history", path)?;
    let model = Model::parse(path, &text)?;
    let damaged = |reason: String| Err(RevisionError::Damaged { path: path.to_owned(), reason });
    if path.file_name().is_none_or(|name| *name != *format!("{}.toml", model.revision)) {
        return damaged(format!("the file says that it is revision {}", model.revision));
    }
    if model.edited_by_hand() {
        return damaged(format!("its effects have the digest {}, not that of its name", model.digest()));
    }
    Ok((model, text))
}

/// Refuses a revision that cannot name a file.
fn file_name(model: &Model) -> Result<(), RevisionError> {
    let revision = &model.revision;
    let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '+' | '-');
    if revision.is_empty() || revision.starts_with('.') || !revision.chars().all(plain) {
        return Err(RevisionError::Name { path: model.path.clone(), revision: revision.clone() });
    }
    Ok(())
}

fn document(path: &Path, text: &str) -> Result<DocumentMut, RevisionError> {
    text.parse().map_err(|_| RevisionError::Shape { path: path.to_owned() })
}

/// The text of a document under another revision and parent.
fn with_header(mut document: DocumentMut, revision: &str, parent: Option<&str>) -> String {
    let header = document.entry("model").or_insert_with(|| Item::Table(Table::new()));
    if let Some(header) = header.as_table_like_mut() {
        set(header, "revision", revision.into());
        match parent {
            Some(parent) => set(header, "parent", parent.into()),
            None => drop(header.remove("parent")),
        }
    }
    document.to_string()
}

/// Sets a value and keeps what stands around it.
fn set(table: &mut dyn TableLike, key: &str, mut to: Value) {
    match table.get_mut(key) {
        Some(Item::Value(old)) => {
            *to.decor_mut() = old.decor().clone();
            *old = to;
        }
        _ => {
            table.insert(key, Item::Value(to));
        }
    }
}

/// Sets `prior.NAME.KEY` in whatever form the file has its priors.
fn set_prior(effect: &mut Table, name: &str, key: &str, number: f64) {
    let dotted = |inline: bool| {
        let mut table = Table::new();
        table.set_dotted(true);
        if inline { Item::Value(Value::InlineTable(InlineTable::new())) } else { Item::Table(table) }
    };
    let priors = effect.entry("prior").or_insert_with(|| dotted(false));
    let inline = priors.is_inline_table();
    let Some(priors) = priors.as_table_like_mut() else { return };
    let prior = priors.entry(name).or_insert_with(|| dotted(inline));
    if let Some(prior) = prior.as_table_like_mut() {
        set(prior, key, number.into());
    }
}

fn prefix(table: &Table) -> String {
    table.decor().prefix().and_then(|p| p.as_str()).unwrap_or_default().to_owned()
}

/// Comments above a table that an empty line parts from it: they are the file's, not the table's.
fn detached(table: Option<&Table>) -> String {
    let above = table.map(prefix).unwrap_or_default();
    let end = above.rfind("\n\n").map_or(0, |at| at + 1);
    let own = &above[..end];
    if own.contains('#') { own.to_owned() } else { String::new() }
}

#[cfg(test)]
mod tests;
