//! Files: plain text files, and `.tgz` archives of them.

use std::fs::File;
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use flate2::read::MultiGzDecoder;

use crate::product::{self, Product};

/// A file by its name, `PRODUCT_DATE_SPACECRAFT_RELEASE.txt`.
#[derive(Clone, Debug)]
pub struct Member {
    /// Product.
    pub product: &'static Product,
    /// `2023-06-01`.
    pub date: String,
    /// `C` or `D`.
    pub spacecraft: char,
    /// `04`.
    pub release: String,
    /// The name itself.
    pub name: String,
}

impl Member {
    /// Parses a file name; `None` for other products, files of both spacecraft (`Y`), reports and stray files.
    pub fn from_name(name: &str) -> Option<Self> {
        let mut parts = name.strip_suffix(".txt")?.split('_');
        let (code, date, spacecraft, release) = (parts.next()?, parts.next()?, parts.next()?, parts.next()?);
        let date_like = date.len() == 10 && date.bytes().all(|b| b.is_ascii_digit() || b == b'-');
        if parts.next().is_some() || !date_like || release.is_empty() {
            return None;
        }
        Some(Self {
            product: product::find(code)?,
            date: date.to_owned(),
            spacecraft: match spacecraft {
                "C" => 'C',
                "D" => 'D',
                _ => return None,
            },
            release: release.to_owned(),
            name: name.to_owned(),
        })
    }
}

/// A file given to the run.
#[derive(Clone, Debug)]
pub struct Container {
    path: PathBuf,
    packed: bool,
    /// Readable members.
    pub members: Vec<Member>,
    /// Why the listing ends early, if it does.
    pub damage: Option<String>,
}

impl Container {
    /// Lists a file's members. An archive is recognised by its first bytes.
    ///
    /// # Errors
    /// The file cannot be opened or read.
    pub fn open(path: &Path) -> std::io::Result<Self> {
        let mut container =
            Self { path: path.to_owned(), packed: packed(&mut File::open(path)?)?, members: Vec::new(), damage: None };
        if container.packed {
            let mut members = Vec::new();
            container.damage = container.visit(|member, _| members.push(member)).err().map(|e| e.to_string());
            container.members = members;
        } else if let Some(member) = path.file_name().and_then(|n| Member::from_name(&n.to_string_lossy())) {
            container.members.push(member);
        }
        Ok(container)
    }

    /// Path as given.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Calls `each` with every readable member and its text, in archive order.
    ///
    /// # Errors
    /// The file or archive ends early or is damaged; the members before were passed on.
    pub fn visit(&self, mut each: impl FnMut(Member, &mut dyn BufRead)) -> std::io::Result<()> {
        let file = File::open(&self.path)?;
        if !self.packed {
            for member in &self.members {
                each(member.clone(), &mut BufReader::with_capacity(1 << 16, &file));
            }
            return Ok(());
        }
        let mut archive = tar::Archive::new(MultiGzDecoder::new(BufReader::new(file)));
        for entry in archive.entries()? {
            let entry = entry?;
            let path = String::from_utf8_lossy(&entry.path_bytes()).into_owned();
            let name = path.rsplit('/').next().unwrap_or_default();
            if let Some(member) = Member::from_name(name) {
                each(member, &mut BufReader::with_capacity(1 << 16, entry));
            }
        }
        Ok(())
    }
}

fn packed(file: &mut File) -> std::io::Result<bool> {
    let mut magic = Vec::new();
    file.take(2).read_to_end(&mut magic)?;
    file.seek(SeekFrom::Start(0))?;
    Ok(magic == [0x1f, 0x8b])
}
