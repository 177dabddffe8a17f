//! The catalogue: what journal and products say, as tables. It holds nothing that is not in them.

use crate::ArchiveError;
use crate::journal::{Event, InputPlace, JournalEntry, SetState};
use crate::product::{EXTRACT, Product, Stage};
use rusqlite::{Connection, OptionalExtension as _, Params, Row as SqlRow, params};
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Changes with the tables: a catalogue of another version is made again.
const VERSION: i64 = 4;

/// How long a question waits for another program's transaction, which takes milliseconds.
const PATIENCE: Duration = Duration::from_secs(20);

const TABLES: &str = "
CREATE TABLE applied (number INTEGER NOT NULL, sha256 TEXT NOT NULL) STRICT;
INSERT INTO applied VALUES (0, '');
CREATE TABLE products (
    id TEXT PRIMARY KEY, number INTEGER NOT NULL, name TEXT NOT NULL, day TEXT NOT NULL, spacecraft TEXT NOT NULL,
    release INTEGER NOT NULL, revision INTEGER NOT NULL, sha256 TEXT NOT NULL, asked_from_ns INTEGER,
    asked_until_ns INTEGER, run_in_ns INTEGER NOT NULL, problem TEXT, digest TEXT, stream TEXT, status TEXT, verdict TEXT, model TEXT,
    fixed_from TEXT, supersedes TEXT, start_ns INTEGER, stop_ns INTEGER, epochs_used INTEGER, chi2_per_dof REAL,
    nis REAL, inconsistent INTEGER, data_loss INTEGER
) STRICT, WITHOUT ROWID;
CREATE INDEX products_by_day ON products (day, spacecraft, name, release, revision);
CREATE TABLE files (
    id TEXT NOT NULL, suffix TEXT NOT NULL, sha256 TEXT NOT NULL, size INTEGER NOT NULL, PRIMARY KEY (id, suffix)
) STRICT, WITHOUT ROWID;
CREATE TABLE extracts (sha256 TEXT PRIMARY KEY) STRICT, WITHOUT ROWID;
CREATE TABLE inputs (
    id TEXT NOT NULL, place INTEGER NOT NULL, role TEXT NOT NULL, name TEXT NOT NULL, sha256 TEXT NOT NULL,
    size INTEGER NOT NULL, PRIMARY KEY (id, place)
) STRICT, WITHOUT ROWID;
CREATE INDEX inputs_by_digest ON inputs (sha256);
CREATE TABLE made_of (
    id TEXT NOT NULL, role TEXT NOT NULL, name TEXT NOT NULL, sha256 TEXT NOT NULL, size INTEGER NOT NULL,
    PRIMARY KEY (id, role)
) STRICT, WITHOUT ROWID;
CREATE INDEX made_of_by_digest ON made_of (sha256);
CREATE TABLE libraries (id TEXT NOT NULL, plugin TEXT NOT NULL, sha256 TEXT NOT NULL, PRIMARY KEY (id, plugin, sha256))
    STRICT, WITHOUT ROWID;
CREATE TABLE places (sha256 TEXT NOT NULL, path TEXT NOT NULL, number INTEGER NOT NULL, PRIMARY KEY (sha256, path))
    STRICT, WITHOUT ROWID;
CREATE TABLE failed (
    day TEXT NOT NULL, spacecraft TEXT NOT NULL, reason TEXT NOT NULL, tried_with TEXT NOT NULL, number INTEGER NOT NULL,
    PRIMARY KEY (day, spacecraft)
) STRICT, WITHOUT ROWID;
CREATE TABLE withdrawn (id TEXT PRIMARY KEY, number INTEGER NOT NULL, reason TEXT NOT NULL) STRICT, WITHOUT ROWID;
CREATE TABLE sets (name TEXT PRIMARY KEY, state TEXT NOT NULL, reason TEXT NOT NULL, number INTEGER NOT NULL)
    STRICT, WITHOUT ROWID;
CREATE TABLE validity (
    set_name TEXT NOT NULL, spacecraft TEXT NOT NULL, from_ns INTEGER NOT NULL, until_ns INTEGER NOT NULL,
    id TEXT NOT NULL, number INTEGER NOT NULL, PRIMARY KEY (set_name, spacecraft, from_ns)
) STRICT, WITHOUT ROWID;
CREATE TABLE seen (path TEXT PRIMARY KEY, sha256 TEXT NOT NULL, size INTEGER, mtime_ns INTEGER, inode INTEGER)
    STRICT, WITHOUT ROWID;
";

/// A product as the catalogue has it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// `COM1B_2035-01-01_SC1_01_0001`.
    pub id: String,
    /// Number of its event.
    pub number: u64,
    /// `COM1B`.
    pub name: String,
    /// UTC day of the first epoch.
    pub day: String,
    /// Spacecraft.
    pub spacecraft: String,
    /// Release.
    pub release: u32,
    /// Revision.
    pub revision: u32,
    /// Why it cannot be read; none for a sound one.
    pub problem: Option<String>,
    /// Digest of what was found and from what.
    pub digest: Option<String>,
    /// `OPER`, `RPRO` or `TEST`.
    pub stream: Option<String>,
    /// `quicklook` or `final`.
    pub status: Option<String>,
    /// `agree`, `disagree` or `weak`.
    pub verdict: Option<String>,
    /// Revision of the model.
    pub model: Option<String>,
    /// The product whose values the model was fixed at: a test on data that were kept out of the fit.
    pub fixed_from: Option<String>,
    /// The product that it took the place of.
    pub supersedes: Option<String>,
    /// First epoch, Unix ns.
    pub start_ns: Option<i64>,
    /// Last epoch, Unix ns.
    pub stop_ns: Option<i64>,
    /// Epochs used.
    pub epochs_used: Option<u64>,
    /// χ² per degree of freedom.
    pub chi2_per_dof: Option<f64>,
    /// Mean normalised innovation squared.
    pub nis: Option<f64>,
    /// Whether the model contradicts the data.
    pub inconsistent: Option<bool>,
    /// Whether data were lost.
    pub data_loss: Option<bool>,
    /// First time that was asked for, Unix ns.
    pub asked_from_ns: Option<i64>,
    /// End of the time that was asked for, Unix ns.
    pub asked_until_ns: Option<i64>,
    /// Data before the time asked for that only settled the stages before the estimators, ns.
    pub run_in_ns: i64,
    /// Why it is not to be used any more.
    pub withdrawn: Option<String>,
    /// Whether it is the newest of its day, spacecraft and name that holds: not withdrawn, not in disagreement, no
    /// test on data that were kept out of a fit.
    pub latest: bool,
}

impl Row {
    /// The id without the revision.
    pub fn stem(&self) -> &str {
        stem(&self.id)
    }
}

/// An id without its revision.
pub fn stem(id: &str) -> &str {
    id.rsplit_once('_').map_or("", |(stem, _)| stem)
}

/// A time in a set.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Validity {
    /// The set.
    pub set: String,
    /// Spacecraft.
    pub spacecraft: String,
    /// First time, Unix ns.
    pub from_ns: i64,
    /// End, exclusive, Unix ns; `i64::MAX` where there is none.
    pub until_ns: i64,
    /// The product that holds.
    pub id: String,
}

/// A content and where it is, or was last.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Place {
    /// `telemetry`, `pipeline` …
    pub role: String,
    /// File name.
    pub name: String,
    /// Digest.
    pub sha256: String,
    /// Bytes.
    pub size: u64,
    /// Where it was last.
    pub path: Option<PathBuf>,
}

/// A file as it was when its digest was last taken.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Seen {
    pub(crate) sha256: String,
    pub(crate) size: u64,
    pub(crate) mtime_ns: i64,
    pub(crate) inode: u64,
}

/// The tables.
#[derive(Debug)]
pub(crate) struct Catalogue {
    connection: Connection,
    path: PathBuf,
}

impl Catalogue {
    /// Opens or makes the catalogue file; one that is damaged or of another version is made again.
    pub(crate) fn open(path: &Path) -> Result<Self, ArchiveError> {
        match Self::of_file(path) {
            Err(error) if is_damage(&error) => {
                tracing::warn!("{} is damaged and is made again from the journal", path.display());
                discard(path);
                Self::of_file(path)
            }
            opened => opened,
        }
        .map_err(|source| ArchiveError::Catalogue { path: path.to_owned(), source })
    }

    fn of_file(path: &Path) -> rusqlite::Result<Self> {
        let mut catalogue = Self { connection: Connection::open(path)?, path: path.to_owned() };
        catalogue.connection.busy_timeout(PATIENCE)?;
        catalogue.prepare()?;
        Ok(catalogue)
    }

    /// Tables in memory, for an archive that cannot be written.
    pub(crate) fn in_memory(path: &Path) -> Result<Self, ArchiveError> {
        let open = || {
            let mut catalogue = Self { connection: Connection::open_in_memory()?, path: path.to_owned() };
            catalogue.prepare()?;
            Ok(catalogue)
        };
        open().map_err(|source| ArchiveError::Catalogue { path: path.to_owned(), source })
    }

    fn prepare(&mut self) -> rusqlite::Result<()> {
        let version = |c: &Connection| c.query_row("PRAGMA user_version", [], |row| row.get::<_, i64>(0));
        if version(&self.connection)? == VERSION {
            return Ok(());
        }
        let transaction = self.connection.transaction_with_behavior(rusqlite::TransactionBehavior::Immediate)?;
        // Another program may have made them in between.
        if version(&transaction)? != VERSION {
            let names = "SELECT name FROM sqlite_master WHERE type = 'table'";
            let old: Vec<String> =
                transaction.prepare(names)?.query_map([], |row| row.get(0))?.collect::<Result<_, _>>()?;
            for name in old {
                transaction.execute_batch(&format!("DROP TABLE \"{name}\""))?;
            }
            transaction.execute_batch(TABLES)?;
            transaction.pragma_update(None, "user_version", VERSION)?;
        }
        transaction.commit()
    }

    /// Empties the tables.
    pub(crate) fn clear(&mut self) -> Result<(), ArchiveError> {
        let clear = |connection: &mut Connection| {
            connection.pragma_update(None, "user_version", 0)?;
            Ok(())
        };
        clear(&mut self.connection).and_then(|()| self.prepare()).map_err(|source| self.error(source))
    }

    fn error(&self, source: rusqlite::Error) -> ArchiveError {
        ArchiveError::Catalogue { path: self.path.clone(), source }
    }

    /// Number and digest of the last entry that the tables know.
    pub(crate) fn applied(&self) -> Result<(u64, String), ArchiveError> {
        let read = |row: &SqlRow<'_>| Ok((row.get::<_, i64>(0)?.unsigned_abs(), row.get(1)?));
        self.connection.query_row("SELECT number, sha256 FROM applied", [], read).map_err(|e| self.error(e))
    }

    /// Enters events that follow on what the tables know, all or none. `read` gives the document of an archived product
    /// by id and digest, or why it cannot be read.
    pub(crate) fn apply(
        &mut self,
        entries: &[(JournalEntry, String)],
        mut read: impl FnMut(&str, &str) -> Result<Product, String>,
    ) -> Result<(), ArchiveError> {
        let mut enter = || -> rusqlite::Result<()> {
            let transaction = self.connection.transaction_with_behavior(rusqlite::TransactionBehavior::Immediate)?;
            let mut applied = transaction.query_row("SELECT number FROM applied", [], |row| row.get::<_, i64>(0))?;
            for (entry, sha256) in entries {
                // Another program may have entered it in between.
                if as_i64(entry.number) == applied + 1 {
                    for event in entry.event.each() {
                        let product = match event {
                            Event::Product { id, sha256, .. } => Some(read(id, sha256)),
                            _ => None,
                        };
                        enter_event(&transaction, as_i64(entry.number), event, product)?;
                    }
                    applied += 1;
                    transaction.execute("UPDATE applied SET number = ?1, sha256 = ?2", params![applied, sha256])?;
                }
            }
            transaction.commit()
        };
        enter().map_err(|e| self.error(e))
    }

    /// Products whose rows fit `condition`, by spacecraft, day, name, release and revision.
    pub(crate) fn products(&self, condition: &str, values: impl Params) -> Result<Vec<Row>, ArchiveError> {
        // The newest that holds, of one day, spacecraft and name.
        let newest = "SELECT id FROM products q LEFT JOIN withdrawn v USING (id) \
             WHERE q.day = p.day AND q.spacecraft = p.spacecraft AND q.name = p.name AND v.id IS NULL \
             AND q.problem IS NULL AND q.verdict IS NOT 'disagree' AND q.fixed_from IS NULL \
             ORDER BY q.release DESC, q.revision DESC LIMIT 1";
        let question = format!(
            "SELECT p.*, w.reason AS withdrawn, p.id IS ({newest}) AS latest FROM products p \
             LEFT JOIN withdrawn w USING (id) WHERE {condition} ORDER BY spacecraft, day, name, release, revision"
        );
        self.all(&question, values, |row| {
            let unsigned = |name: &str| row.get::<_, Option<i64>>(name).map(|x| x.map(i64::unsigned_abs));
            let number = |name: &str| row.get::<_, i64>(name);
            Ok(Row {
                id: row.get("id")?,
                number: number("number")?.unsigned_abs(),
                name: row.get("name")?,
                day: row.get("day")?,
                spacecraft: row.get("spacecraft")?,
                release: u32::try_from(number("release")?).unwrap_or(u32::MAX),
                revision: u32::try_from(number("revision")?).unwrap_or(u32::MAX),
                problem: row.get("problem")?,
                digest: row.get("digest")?,
                stream: row.get("stream")?,
                status: row.get("status")?,
                verdict: row.get("verdict")?,
                model: row.get("model")?,
                fixed_from: row.get("fixed_from")?,
                supersedes: row.get("supersedes")?,
                start_ns: row.get("start_ns")?,
                stop_ns: row.get("stop_ns")?,
                epochs_used: unsigned("epochs_used")?,
                chi2_per_dof: row.get("chi2_per_dof")?,
                nis: row.get("nis")?,
                inconsistent: row.get("inconsistent")?,
                data_loss: row.get("data_loss")?,
                asked_from_ns: row.get("asked_from_ns")?,
                asked_until_ns: row.get("asked_until_ns")?,
                run_in_ns: row.get("run_in_ns")?,
                withdrawn: row.get("withdrawn")?,
                latest: row.get("latest")?,
            })
        })
    }

    /// Digest of a product's document.
    pub(crate) fn document(&self, id: &str) -> Result<Option<String>, ArchiveError> {
        let question = "SELECT sha256 FROM products WHERE id = ?1";
        self.connection.query_row(question, [id], |row| row.get(0)).optional().map_err(|e| self.error(e))
    }

    /// Suffix, digest and size of every file of a product.
    pub(crate) fn files(&self, id: &str) -> Result<Vec<(String, String, u64)>, ArchiveError> {
        let question = "SELECT suffix, sha256, size FROM files WHERE id = ?1 ORDER BY suffix";
        self.all(question, [id], |row| Ok((row.get(0)?, row.get(1)?, row.get::<_, i64>(2)?.unsigned_abs())))
    }

    /// Inputs of a product in their order, without places.
    pub(crate) fn inputs(&self, id: &str) -> Result<Vec<Place>, ArchiveError> {
        self.all("SELECT role, name, sha256, size, NULL FROM inputs WHERE id = ?1 ORDER BY place", [id], place)
    }

    /// Where a content was seen, the last place first.
    pub(crate) fn places(&self, sha256: &str) -> Result<Vec<PathBuf>, ArchiveError> {
        let question = "SELECT path FROM places WHERE sha256 = ?1 ORDER BY number DESC, path";
        self.all(question, [sha256], |row| row.get::<_, String>(0).map(PathBuf::from))
    }

    /// Contents of the archive that a product was made of, or left.
    pub(crate) fn made_of(&self, id: &str) -> Result<Vec<Place>, ArchiveError> {
        self.all("SELECT role, name, sha256, size, NULL FROM made_of WHERE id = ?1 ORDER BY role", [id], place)
    }

    /// Plugins that made a product, with the digests of their libraries.
    pub(crate) fn libraries(&self, id: &str) -> Result<Vec<(String, String)>, ArchiveError> {
        let question = "SELECT plugin, sha256 FROM libraries WHERE id = ?1 ORDER BY plugin, sha256";
        self.all(question, [id], |row| Ok((row.get(0)?, row.get(1)?)))
    }

    /// Products that a content entered, by digest.
    pub(crate) fn products_of(&self, sha256: &str) -> Result<Vec<String>, ArchiveError> {
        let question = "SELECT DISTINCT id FROM inputs WHERE sha256 = ?1 ORDER BY id";
        self.all(question, [sha256], |row| row.get(0))
    }

    /// Products for which a content is kept by a role.
    pub(crate) fn products_with(&self, role: &str, sha256: &str) -> Result<Vec<String>, ArchiveError> {
        let question = "SELECT id FROM made_of WHERE role = ?1 AND sha256 = ?2 ORDER BY id";
        self.all(question, [role, sha256], |row| row.get(0))
    }

    /// Whether any event names a content.
    pub(crate) fn names(&self, sha256: &str) -> Result<bool, ArchiveError> {
        let question = "SELECT EXISTS (SELECT 1 FROM files WHERE sha256 = ?1) \
             OR EXISTS (SELECT 1 FROM extracts WHERE sha256 = ?1) \
             OR EXISTS (SELECT 1 FROM made_of WHERE sha256 = ?1) \
             OR EXISTS (SELECT 1 FROM products WHERE sha256 = ?1)";
        self.connection.query_row(question, [sha256], |row| row.get(0)).map_err(|e| self.error(e))
    }

    /// Sets with their states.
    pub(crate) fn sets(&self) -> Result<Vec<(String, String)>, ArchiveError> {
        self.all("SELECT name, state FROM sets ORDER BY name", [], |row| Ok((row.get(0)?, row.get(1)?)))
    }

    /// Reason and digest of what it was tried with, of the last failure of a day that no product followed.
    pub(crate) fn failed(&self, day: &str, spacecraft: &str) -> Result<Option<(String, String)>, ArchiveError> {
        let question = "SELECT reason, tried_with FROM failed WHERE day = ?1 AND spacecraft = ?2 AND number > \
             (SELECT coalesce(max(number), 0) FROM products WHERE day = ?1 AND spacecraft = ?2)";
        let read = |row: &SqlRow<'_>| Ok((row.get(0)?, row.get(1)?));
        self.connection.query_row(question, [day, spacecraft], read).optional().map_err(|e| self.error(e))
    }

    /// Times of a set, in order; of all sets where none is named.
    pub(crate) fn validity(&self, set: Option<&str>) -> Result<Vec<Validity>, ArchiveError> {
        let question = "SELECT set_name, spacecraft, from_ns, until_ns, id FROM validity \
             WHERE ?1 IS NULL OR set_name = ?1 ORDER BY set_name, spacecraft, from_ns";
        self.all(question, [set], |row| {
            Ok(Validity {
                set: row.get(0)?,
                spacecraft: row.get(1)?,
                from_ns: row.get(2)?,
                until_ns: row.get(3)?,
                id: row.get(4)?,
            })
        })
    }

    /// How a file was when its digest was last taken.
    pub(crate) fn seen(&self, path: &str) -> Result<Option<Seen>, ArchiveError> {
        let question = "SELECT sha256, size, mtime_ns, inode FROM seen WHERE path = ?1";
        let read = |row: &SqlRow<'_>| {
            Ok(Seen {
                sha256: row.get(0)?,
                size: row.get::<_, i64>(1)?.cast_unsigned(),
                mtime_ns: row.get(2)?,
                inode: row.get::<_, i64>(3)?.cast_unsigned(),
            })
        };
        self.connection.query_row(question, [path], read).optional().map_err(|e| self.error(e))
    }

    /// Keeps how a file was when its digest was taken. What cannot be kept is only looked at again.
    pub(crate) fn keep_seen(&self, path: &str, seen: &Seen) {
        let values = params![path, seen.sha256, seen.size.cast_signed(), seen.mtime_ns, seen.inode.cast_signed()];
        let kept = self.connection.execute("INSERT OR REPLACE INTO seen VALUES (?1, ?2, ?3, ?4, ?5)", values);
        if let Err(error) = kept {
            tracing::debug!("the catalogue takes no note of {path}: {error}");
        }
    }

    /// Every table but `seen` as text, for comparison.
    #[cfg(test)]
    pub(crate) fn dump(&self) -> Vec<String> {
        let tables = [
            "applied",
            "products",
            "files",
            "inputs",
            "made_of",
            "libraries",
            "places",
            "failed",
            "withdrawn",
            "sets",
            "validity",
        ];
        let text = |table: &str| {
            let mut question = self.connection.prepare(&format!("SELECT * FROM {table} ORDER BY 1, 2")).expect("SQL");
            let columns = question.column_count();
            let rows = question.query_map([], |row| {
                let value = |i| row.get::<_, rusqlite::types::Value>(i).map(|v| format!("{v:?}"));
                (0..columns).map(value).collect::<Result<Vec<_>, _>>()
            });
            rows.expect("rows").map(|row| format!("{table} {:?}", row.expect("a row"))).collect::<Vec<_>>()
        };
        tables.into_iter().flat_map(text).collect()
    }

    fn all<T>(
        &self,
        question: &str,
        values: impl Params,
        read: impl FnMut(&SqlRow<'_>) -> rusqlite::Result<T>,
    ) -> Result<Vec<T>, ArchiveError> {
        let ask = || self.connection.prepare(question)?.query_map(values, read)?.collect::<Result<Vec<T>, _>>();
        ask().map_err(|e| self.error(e))
    }
}

/// Removes a catalogue and what SQLite keeps beside it.
pub(crate) fn discard(path: &Path) {
    for suffix in ["", "-journal", "-wal", "-shm"] {
        let mut name = path.as_os_str().to_owned();
        name.push(suffix);
        let _ = std::fs::remove_file(name); // what stays is told when it is opened
    }
}

fn is_damage(error: &rusqlite::Error) -> bool {
    use rusqlite::ErrorCode::{DatabaseCorrupt, NotADatabase};
    // Tables that are not what they should be fail as unknown names.
    error.sqlite_error_code().is_some_and(|code| matches!(code, DatabaseCorrupt | NotADatabase))
        || matches!(error, rusqlite::Error::SqlInputError { .. })
}

fn as_i64(number: u64) -> i64 {
    i64::try_from(number).unwrap_or(i64::MAX)
}

fn place(row: &SqlRow<'_>) -> rusqlite::Result<Place> {
    Ok(Place {
        role: row.get(0)?,
        name: row.get(1)?,
        sha256: row.get(2)?,
        size: row.get::<_, i64>(3)?.unsigned_abs(),
        path: row.get::<_, Option<String>>(4)?.map(PathBuf::from),
    })
}

/// Name, day, spacecraft, release and revision of a product's id.
pub(crate) fn parts(id: &str) -> Option<[&str; 5]> {
    let parts: Vec<&str> = id.split('_').collect();
    parts.try_into().ok()
}

fn enter_event(
    connection: &Connection,
    number: i64,
    event: &Event,
    product: Option<Result<Product, String>>,
) -> rusqlite::Result<()> {
    match event {
        Event::Several { .. } => {} // each is entered by itself
        Event::Product { id, sha256, made_of, places, from_ns, until_ns, run_in_ns } => {
            let [name, day, spacecraft, release, revision] = parts(id).unwrap_or([""; 5]);
            connection.execute(
                "INSERT INTO products (id, number, name, day, spacecraft, release, revision, sha256, asked_from_ns, \
                 asked_until_ns, run_in_ns) VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9, ?10, ?11)",
                params![
                    id,
                    number,
                    name,
                    day,
                    spacecraft,
                    release.parse::<i64>().unwrap_or(0),
                    revision.parse::<i64>().unwrap_or(0),
                    sha256,
                    from_ns,
                    until_ns,
                    run_in_ns
                ],
            )?;
            for (role, stored) in made_of {
                connection.execute(
                    "INSERT INTO made_of VALUES (?1, ?2, ?3, ?4, ?5)",
                    params![id, role, stored.name, stored.sha256, as_i64(stored.size)],
                )?;
            }
            enter_places(connection, number, places)?;
            match product {
                Some(Ok(product)) => enter_product(connection, id, &product)?,
                other => {
                    let problem = other.and_then(Result::err).unwrap_or_else(|| "it was not read".to_owned());
                    connection.execute("UPDATE products SET problem = ?2 WHERE id = ?1", [id, &problem])?;
                }
            }
        }
        Event::Extract { id, sha256, size } => {
            // One that another has taken the place of stays among what the archive keeps.
            connection.execute("INSERT OR IGNORE INTO extracts VALUES (?1)", [sha256])?;
            enter_file(connection, id, EXTRACT, sha256, *size)?;
        }
        Event::Failed { day, spacecraft, reason, tried_with } => {
            let values = params![day, spacecraft, reason, tried_with, number];
            connection.execute("INSERT OR REPLACE INTO failed VALUES (?1, ?2, ?3, ?4, ?5)", values)?;
        }
        Event::Places { places } => enter_places(connection, number, places)?,
        Event::Withdrawn { id, reason } => {
            let values = params![id, number, reason];
            connection.execute("INSERT OR REPLACE INTO withdrawn VALUES (?1, ?2, ?3)", values)?;
        }
        Event::Certified { set, id, from_ns, until_ns } => {
            open_set(connection, set, number)?;
            let spacecraft = parts(id).map_or("", |parts| parts[2]);
            let until_ns = until_ns.unwrap_or(i64::MAX);
            connection.execute(
                "INSERT INTO validity VALUES (?1, ?2, ?3, ?4, ?5, ?6)",
                params![set, spacecraft, from_ns, until_ns, id, number],
            )?;
        }
        Event::Decertified { set, spacecraft, from_ns, until_ns } => {
            let (from, until) = (from_ns.unwrap_or(i64::MIN), until_ns.unwrap_or(i64::MAX));
            cut(connection, set, spacecraft, from, until)?;
        }
        Event::Set { set, state, reason } => {
            let values = params![set, state.name(), reason, number];
            connection.execute("INSERT OR REPLACE INTO sets VALUES (?1, ?2, ?3, ?4)", values)?;
        }
    }
    Ok(())
}

fn enter_product(connection: &Connection, id: &str, product: &Product) -> rusqlite::Result<()> {
    let attributes = &product.header.non_standard_attributes;
    let quality = &product.quality;
    let name = |value: serde_json::Value| value.as_str().unwrap_or_default().to_owned();
    let finite = |number: f64| Some(number).filter(|x| x.is_finite());
    connection.execute(
        "UPDATE products SET digest = ?2, stream = ?3, status = ?4, verdict = ?5, model = ?6, fixed_from = ?7, \
         supersedes = ?8, start_ns = ?9, stop_ns = ?10, epochs_used = ?11, chi2_per_dof = ?12, nis = ?13, \
         inconsistent = ?14, data_loss = ?15 WHERE id = ?1",
        params![
            id,
            attributes.sha256,
            name(serde_json::json!(attributes.stream)),
            name(serde_json::json!(attributes.status)),
            product.result.verdict,
            product.model.revision,
            product.model.fixed_from,
            product.supersedes.as_ref().map(|earlier| &earlier.id),
            attributes.start_time_epoch_ns,
            attributes.stop_time_epoch_ns,
            as_i64(quality.epochs_used),
            finite(quality.chi2_per_dof),
            finite(quality.nis),
            quality.inconsistent,
            quality.data_loss,
        ],
    )?;
    for file in &product.attachments {
        enter_file(connection, id, &file.suffix, &file.sha256, file.size)?;
    }
    for (place, input) in product.inputs.iter().enumerate() {
        connection.execute(
            "INSERT INTO inputs VALUES (?1, ?2, ?3, ?4, ?5, ?6)",
            params![id, as_i64(place as u64), input.role, input.name, input.sha256, as_i64(input.size)],
        )?;
    }
    for Stage { plugin, library_sha256, .. } in &product.history {
        // An effect has a stage for each instance.
        let entry = "INSERT OR IGNORE INTO libraries VALUES (?1, ?2, ?3)";
        connection.execute(entry, params![id, plugin, library_sha256])?;
    }
    Ok(())
}

fn enter_file(connection: &Connection, id: &str, suffix: &str, sha256: &str, size: u64) -> rusqlite::Result<()> {
    let values = params![id, suffix, sha256, as_i64(size)];
    connection.execute("INSERT OR REPLACE INTO files VALUES (?1, ?2, ?3, ?4)", values).map(drop)
}

fn enter_places(connection: &Connection, number: i64, places: &[InputPlace]) -> rusqlite::Result<()> {
    for place in places {
        let values = params![place.sha256, place.path.to_string_lossy(), number];
        connection.execute("INSERT OR REPLACE INTO places VALUES (?1, ?2, ?3)", values)?;
    }
    Ok(())
}

fn open_set(connection: &Connection, set: &str, number: i64) -> rusqlite::Result<()> {
    let state = SetState::Open.name();
    connection.execute("INSERT OR IGNORE INTO sets VALUES (?1, ?2, '', ?3)", params![set, state, number]).map(drop)
}

/// Takes `[from, until)` out of the times of a set; a time that reaches beyond both ends becomes two.
fn cut(connection: &Connection, set: &str, spacecraft: &str, from: i64, until: i64) -> rusqlite::Result<()> {
    let question = "SELECT from_ns, until_ns, id, number FROM validity \
         WHERE set_name = ?1 AND spacecraft = ?2 AND from_ns < ?4 AND until_ns > ?3";
    let mut asked = connection.prepare(question)?;
    let read = |row: &SqlRow<'_>| Ok((row.get(0)?, row.get(1)?, row.get(2)?, row.get(3)?));
    let hit: Vec<(i64, i64, String, i64)> =
        asked.query_map(params![set, spacecraft, from, until], read)?.collect::<Result<_, _>>()?;
    for (start, end, id, number) in hit {
        connection.execute(
            "DELETE FROM validity WHERE set_name = ?1 AND spacecraft = ?2 AND from_ns = ?3",
            params![set, spacecraft, start],
        )?;
        for (a, b) in [(start, end.min(from)), (start.max(until), end)].into_iter().filter(|(a, b)| a < b) {
            connection.execute(
                "INSERT INTO validity VALUES (?1, ?2, ?3, ?4, ?5, ?6)",
                params![set, spacecraft, a, b, id, number],
            )?;
        }
    }
    Ok(())
}
