//! What an archive holds: products by name, by day and by what they are; their files and what they were made of.

use crate::ArchiveError;
use crate::archive::Archive;
use crate::catalogue::{Place, Row, Seen, Validity};
use crate::files::{IoContext as _, Problem, inode, mtime_ns, sha256_of};
use crate::objects::entries;
use crate::product::{self, EXTRACT, JOINT, PRODUCT, Product, STATE};
use chrono::NaiveDate;
use std::collections::BTreeSet;
use std::fs;
use std::path::PathBuf;

/// Names in an archive that are its own.
const OWN: [&str; 8] = [
    "objects",
    "journal",
    "staging",
    "sums",
    "catalogue.sqlite",
    "catalogue.sqlite-journal",
    "catalogue.sqlite-wal",
    "catalogue.sqlite-shm",
];

/// What an archive holds.
#[derive(Clone, Debug, Default)]
pub struct Listing {
    /// Products by spacecraft, day, name, release and revision.
    pub entries: Vec<Entry>,
    /// Files that are no sound product; nothing is done to them.
    pub problems: Vec<Problem>,
}

/// A product in an archive.
#[derive(Clone, Debug)]
pub struct Entry {
    /// What the catalogue says.
    pub row: Row,
    /// Its `.toml`.
    pub path: PathBuf,
}

impl Entry {
    /// The id without the revision.
    pub fn stem(&self) -> &str {
        self.row.stem()
    }
}

/// Which products are listed; all of them by default.
#[derive(Clone, Debug, Default)]
pub struct Find {
    /// First day.
    pub from: Option<NaiveDate>,
    /// Last day.
    pub until: Option<NaiveDate>,
    /// Spacecraft.
    pub spacecraft: Option<String>,
    /// `agree`, `disagree` or `weak`.
    pub verdict: Option<String>,
    /// Revision of the model, or its beginning.
    pub model: Option<String>,
    /// Those that a set names.
    pub set: Option<String>,
    /// Only the newest of each day that holds.
    pub latest: bool,
}

impl Archive {
    /// Reads a product and compares it, and every file beside it, with what was archived.
    ///
    /// # Errors
    /// There is no such product, or it is damaged.
    pub fn product(&self, id: &str) -> Result<Product, ArchiveError> {
        self.compare(id, true)?;
        product::read(&self.path_of(id))
    }

    /// Compares a product, and every file beside it, with what was archived; a file that looks as when its digest was
    /// last taken is taken for that one.
    ///
    /// # Errors
    /// There is no such product, or it is damaged.
    pub fn looks_sound(&self, id: &str) -> Result<(), ArchiveError> {
        self.compare(id, false)
    }

    fn compare(&self, id: &str, fully: bool) -> Result<(), ArchiveError> {
        if let Some(reason) = self.row(id)?.problem {
            return Err(ArchiveError::Damaged { path: self.path_of(id), reason });
        }
        // An extract is made from the product and no part of it; whoever reads one compares it.
        let files = self.files_of(id)?;
        let mut own = files.iter().filter(|(suffix, ..)| suffix != EXTRACT);
        own.try_for_each(|(suffix, sha256, _)| self.check(id, suffix, sha256, fully))
    }

    /// Suffix, digest and size of the files of a product, itself among them.
    ///
    /// # Errors
    /// The catalogue cannot be read.
    pub fn files_of(&self, id: &str) -> Result<Vec<(String, String, u64)>, ArchiveError> {
        let mut files = self.catalogue.files(id)?;
        let made_of = self.catalogue.made_of(id)?;
        let state = made_of.into_iter().find(|place| place.role == "state_out");
        files.extend(state.map(|place| (STATE.to_owned(), place.sha256, place.size)));
        let own = self.catalogue.products("p.id = ?1", [id])?;
        if !own.is_empty() {
            let (sha256, size) = self.document_of(id)?;
            files.push((PRODUCT.to_owned(), sha256, size));
        }
        Ok(files)
    }

    /// Reads a product and compares it, but not the files beside it, with what was archived.
    ///
    /// # Errors
    /// There is no such product, or it is damaged.
    pub fn document(&self, id: &str) -> Result<Product, ArchiveError> {
        let (sha256, _) = self.document_of(id)?;
        self.check(id, PRODUCT, &sha256, false)?;
        product::read(&self.path_of(id))
    }

    /// Digest and size of a product's document.
    fn document_of(&self, id: &str) -> Result<(String, u64), ArchiveError> {
        let sha256 = self.catalogue.document(id)?.ok_or_else(|| self.missing(id))?;
        let size = fs::metadata(self.objects.path(&sha256)).map_or(0, |m| m.len());
        Ok((sha256, size))
    }

    /// A file beside a product, compared with its digest.
    ///
    /// # Errors
    /// There is none, or it is damaged.
    pub fn read_file(&self, id: &str, suffix: &str) -> Result<Vec<u8>, ArchiveError> {
        self.content(&self.digest_of(id, suffix)?)
    }

    /// Digest of a file beside a product, as it is now.
    ///
    /// # Errors
    /// There is none.
    pub fn digest_of(&self, id: &str, suffix: &str) -> Result<String, ArchiveError> {
        let found = self.files_of(id)?.into_iter().find(|(found, ..)| found == suffix);
        found.map(|(_, sha256, _)| sha256).ok_or_else(|| {
            let id = format!("{id}.{suffix}");
            ArchiveError::NotFound { id, folder: self.folder.clone() }
        })
    }

    /// The content with a digest, compared with it: what a file was before it was replaced is still there.
    ///
    /// # Errors
    /// There is none, or it is damaged.
    pub fn content(&self, sha256: &str) -> Result<Vec<u8>, ArchiveError> {
        self.objects.read(sha256)
    }

    /// Compares a file with its digest. Without `fully`, one that looks as when its digest was last taken is taken for
    /// the same.
    fn check(&self, id: &str, suffix: &str, sha256: &str, fully: bool) -> Result<(), ArchiveError> {
        let name = format!("{id}.{suffix}");
        let path = self.folder.join(&name);
        let stat = fs::metadata(&path).at("read", &path)?;
        let now = Seen { sha256: sha256.to_owned(), size: stat.len(), mtime_ns: mtime_ns(&stat), inode: inode(&stat) };
        let looks_the_same = self.catalogue.seen(&name)?.is_some_and(|before| before == now);
        if !fully && looks_the_same {
            return Ok(());
        }
        let found = sha256_of(&path).at("read", &path)?;
        if found != sha256 {
            let reason = format!("its digest is {found}, the archive says {sha256}");
            return Err(ArchiveError::Damaged { path, reason });
        }
        if self.writable && !looks_the_same {
            self.catalogue.keep_seen(&name, &now);
        }
        Ok(())
    }

    /// What the catalogue says of a product.
    ///
    /// # Errors
    /// There is none.
    pub fn row(&self, id: &str) -> Result<Row, ArchiveError> {
        self.catalogue.products("p.id = ?1", [id])?.pop().ok_or_else(|| self.missing(id))
    }

    /// What the catalogue says of all products, by spacecraft, day, name, release and revision. No file is looked at.
    ///
    /// # Errors
    /// The catalogue cannot be read.
    pub fn rows(&self) -> Result<Vec<Row>, ArchiveError> {
        self.catalogue.products("1", [])
    }

    /// The same of products that have a file with this suffix beside them and are not withdrawn.
    ///
    /// # Errors
    /// The catalogue cannot be read.
    pub fn rows_with(&self, suffix: &str) -> Result<Vec<Row>, ArchiveError> {
        self.catalogue.products("w.reason IS NULL AND p.id IN (SELECT id FROM files WHERE suffix = ?1)", [suffix])
    }

    /// Products that fit, and what is wrong in the folder. A file that does not look as it was archived is compared
    /// with its digest.
    ///
    /// # Errors
    /// The folder or the catalogue cannot be read.
    pub fn list(&self, find: &Find) -> Result<Listing, ArchiveError> {
        let mut listing = Listing::default();
        let mut known = BTreeSet::new();
        for row in self.catalogue.products("1", [])? {
            let mut sound = row.problem.clone().map_or(Ok(()), Err);
            for (suffix, sha256, _) in self.files_of(&row.id)? {
                let name = format!("{}.{suffix}", row.id);
                let checked = self.check(&row.id, &suffix, &sha256, false).map_err(|e| e.to_string());
                match checked {
                    Err(reason) if suffix == EXTRACT => {
                        listing.problems.push(Problem { path: self.folder.join(&name), reason });
                    }
                    checked => sound = sound.and(checked),
                }
                known.insert(name);
            }
            let path = self.path_of(&row.id);
            match sound {
                Ok(()) => listing.entries.push(Entry { row, path }),
                Err(reason) => listing.problems.push(Problem { path, reason }),
            }
        }
        for name in entries(&self.folder)? {
            if !name.starts_with('.') && !OWN.contains(&name.as_str()) && !known.contains(&name) {
                let reason = "belongs to no product of the archive".to_owned();
                listing.problems.push(Problem { path: self.folder.join(name), reason });
            }
        }
        let in_set = find.set.as_deref().map(|set| self.catalogue.validity(Some(set))).transpose()?;
        listing.entries.retain(|entry| {
            let row = &entry.row;
            let is = |wanted: &Option<String>, found: Option<&str>| wanted.as_deref().is_none_or(|w| found == Some(w));
            let day = row.day.parse::<NaiveDate>().ok();
            find.from.is_none_or(|from| day.is_some_and(|day| from <= day))
                && find.until.is_none_or(|until| day.is_some_and(|day| day <= until))
                && is(&find.spacecraft, Some(&row.spacecraft))
                && is(&find.verdict, row.verdict.as_deref())
                && find.model.as_ref().is_none_or(|m| row.model.as_ref().is_some_and(|found| found.starts_with(m)))
                && in_set.as_ref().is_none_or(|set| set.iter().any(|v| v.id == row.id))
                && (!find.latest || row.latest)
        });
        Ok(listing)
    }

    /// Finds a product by its id, by its id without the revision (the newest one then) or by its day, which does not
    /// find those of many days. A withdrawn one is found by its id alone.
    ///
    /// # Errors
    /// There is none, or the day has products of several series.
    pub fn find(&self, name: &str) -> Result<Entry, ArchiveError> {
        let id = name.strip_suffix(".toml").unwrap_or(name);
        let entry = |row: Row| Entry { path: self.path_of(&row.id), row };
        if let Some(row) = self.catalogue.products("p.id = ?1", [id])?.pop() {
            return Ok(entry(row));
        }
        let condition =
            "((p.day = ?1 AND p.name <> ?2) OR substr(p.id, 1, length(p.id) - 5) = ?1) AND w.reason IS NULL";
        let mut found: Vec<Entry> = self.catalogue.products(condition, [id, JOINT])?.into_iter().map(entry).collect();
        let series = |e: &Entry| (e.row.spacecraft.clone(), e.row.name.clone());
        if let Some(last) = found.last()
            && found.iter().any(|e| series(e) != series(last))
        {
            return Err(self.several(id, &found));
        }
        found.pop().ok_or_else(|| self.missing(id))
    }

    /// The newest product of every day from `first` to `last` that has one, in order; withdrawn ones and tests on data
    /// kept out of a fit are left out.
    ///
    /// # Errors
    /// No day has one, or a day has products of several spacecraft.
    pub fn find_days(&self, first: NaiveDate, last: NaiveDate) -> Result<Vec<Entry>, ArchiveError> {
        let mut newest = self.newest()?;
        newest.retain(|entry| entry.row.day.parse().is_ok_and(|day: NaiveDate| first <= day && day <= last));
        newest.sort_by(|a, b| a.row.day.cmp(&b.row.day));
        if let Some(two) = newest.windows(2).find(|two| two[0].row.day == two[1].row.day) {
            return Err(self.several(&two[0].row.day, two));
        }
        if newest.is_empty() {
            return Err(self.missing(&format!("{first}..{last}")));
        }
        Ok(newest)
    }

    /// The newest product of every day, spacecraft and name, whatever its verdict; withdrawn ones, tests on data kept
    /// out of a fit and products of many days are left out.
    ///
    /// # Errors
    /// The catalogue cannot be read.
    pub fn newest(&self) -> Result<Vec<Entry>, ArchiveError> {
        let mut newest: Vec<Entry> = Vec::new();
        let condition = "w.reason IS NULL AND p.problem IS NULL AND p.fixed_from IS NULL AND p.name <> ?1";
        for row in self.catalogue.products(condition, [JOINT])? {
            let of = |row: &Row| (row.day.clone(), row.spacecraft.clone(), row.name.clone());
            if newest.last().is_some_and(|last| of(&last.row) == of(&row)) {
                newest.pop();
            }
            newest.push(Entry { path: self.path_of(&row.id), row });
        }
        Ok(newest)
    }

    fn several(&self, day: &str, found: &[Entry]) -> ArchiveError {
        let mut stems: Vec<&str> = found.iter().map(Entry::stem).collect();
        stems.dedup();
        ArchiveError::Several { day: day.to_owned(), folder: self.folder.clone(), stems: stems.join(", ") }
    }

    /// What a product was made of: its inputs in their order, each at a place where a file is, or where it was last.
    ///
    /// # Errors
    /// The catalogue cannot be read.
    pub fn inputs(&self, id: &str) -> Result<Vec<Place>, ArchiveError> {
        let mut inputs = self.catalogue.inputs(id)?;
        for input in &mut inputs {
            let places = self.catalogue.places(&input.sha256)?;
            input.path = places.iter().find(|path| path.is_file()).or(places.first()).cloned();
        }
        Ok(inputs)
    }

    /// Plugins that made a product, with the digests of their libraries.
    ///
    /// # Errors
    /// The catalogue cannot be read.
    pub fn libraries(&self, id: &str) -> Result<Vec<(String, String)>, ArchiveError> {
        self.catalogue.libraries(id)
    }

    /// Where a content lies that the archive keeps for a product by `role`: `pipeline`, `mission`, `model`, `state_in`,
    /// `state_out`.
    ///
    /// # Errors
    /// The catalogue cannot be read, or there is none.
    pub fn made_of(&self, id: &str, role: &str) -> Result<Option<Place>, ArchiveError> {
        let mut all = self.catalogue.made_of(id)?;
        all.retain(|place| place.role == role);
        Ok(all.pop().map(|place| Place { path: Some(self.objects.path(&place.sha256)), ..place }))
    }

    /// Every content that the archive keeps for a product, by role.
    ///
    /// # Errors
    /// The catalogue cannot be read.
    pub fn all_made_of(&self, id: &str) -> Result<Vec<Place>, ArchiveError> {
        let at = |place: Place| Place { path: Some(self.objects.path(&place.sha256)), ..place };
        Ok(self.catalogue.made_of(id)?.into_iter().map(at).collect())
    }

    /// Products for which the archive keeps a content by `role`, by its digest.
    ///
    /// # Errors
    /// The catalogue cannot be read.
    pub fn products_with(&self, role: &str, sha256: &str) -> Result<Vec<String>, ArchiveError> {
        self.catalogue.products_with(role, sha256)
    }

    /// Products that a content entered, by digest.
    ///
    /// # Errors
    /// The catalogue cannot be read.
    pub fn products_of(&self, sha256: &str) -> Result<Vec<String>, ArchiveError> {
        self.catalogue.products_of(sha256)
    }

    /// Why a day gave no product, and a digest of what it was tried with; none where a product followed.
    ///
    /// # Errors
    /// The catalogue cannot be read.
    pub fn failed(&self, day: &str, spacecraft: &str) -> Result<Option<(String, String)>, ArchiveError> {
        self.catalogue.failed(day, spacecraft)
    }

    /// The newest product of a day that was no test, withdrawn or not.
    ///
    /// # Errors
    /// The catalogue cannot be read.
    pub fn of_day(&self, day: &str, spacecraft: &str, name: &str) -> Result<Option<Row>, ArchiveError> {
        let condition = "p.day = ?1 AND p.spacecraft = ?2 AND p.name = ?3 AND p.problem IS NULL AND p.stream <> 'TEST'";
        Ok(self.catalogue.products(condition, [day, spacecraft, name])?.pop())
    }

    /// Sets with their states.
    ///
    /// # Errors
    /// The catalogue cannot be read.
    pub fn sets(&self) -> Result<Vec<(String, String)>, ArchiveError> {
        self.catalogue.sets()
    }

    /// Times of a set, or of all.
    ///
    /// # Errors
    /// The catalogue cannot be read.
    pub fn validity(&self, set: Option<&str>) -> Result<Vec<Validity>, ArchiveError> {
        self.catalogue.validity(set)
    }

    /// The newest revision of a product with a digest.
    ///
    /// # Errors
    /// There is none.
    pub fn with_digest(&self, stem: &str, sha256: &str) -> Result<Row, ArchiveError> {
        let condition = "substr(p.id, 1, length(p.id) - 5) = ?1 AND p.digest = ?2";
        let gone =
            || ArchiveError::NotFound { id: format!("{stem} with the digest {sha256}"), folder: self.folder.clone() };
        self.catalogue.products(condition, [stem, sha256])?.pop().ok_or_else(gone)
    }

    /// Products of a name, sound or not, in the order of days and revisions.
    ///
    /// # Errors
    /// The catalogue cannot be read.
    pub fn named(&self, name: &str) -> Result<Vec<Row>, ArchiveError> {
        self.catalogue.products("p.name = ?1", [name])
    }

    /// Ids of all products, sound or not.
    ///
    /// # Errors
    /// The catalogue cannot be read.
    pub fn ids(&self) -> Result<Vec<String>, ArchiveError> {
        Ok(self.catalogue.products("1", [])?.into_iter().map(|row| row.id).collect())
    }
}
