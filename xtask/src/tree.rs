//! Files in memory by their place in an installation, `bin/dragfree`.

use crate::Failure;
use std::collections::BTreeMap;
use std::io::Write;
use std::path::Path;

/// Files by path, in order, so that the same files make the same archive.
#[derive(Debug, Default)]
pub(crate) struct Tree(BTreeMap<String, File>);

#[derive(Debug)]
struct File {
    bytes: Vec<u8>,
    executable: bool,
}

impl Tree {
    pub(crate) fn put(&mut self, path: impl Into<String>, bytes: impl Into<Vec<u8>>) {
        self.0.insert(path.into(), File { bytes: bytes.into(), executable: false });
    }

    pub(crate) fn put_program(&mut self, path: impl Into<String>, bytes: Vec<u8>) {
        self.0.insert(path.into(), File { bytes, executable: true });
    }

    /// A file, or a folder with all below it but what is hidden.
    pub(crate) fn copy(&mut self, from: &Path, to: &str) -> Result<(), Failure> {
        let said = |error: std::io::Error| format!("cannot read {}: {error}", from.display());
        if from.is_file() {
            self.put(to, std::fs::read(from).map_err(said)?);
            return Ok(());
        }
        for entry in std::fs::read_dir(from).map_err(said)? {
            let entry = entry.map_err(said)?;
            let name = entry.file_name().to_string_lossy().into_owned();
            if !name.starts_with('.') {
                self.copy(&entry.path(), &format!("{to}/{name}"))?;
            }
        }
        Ok(())
    }

    /// All bytes of all files.
    pub(crate) fn size(&self) -> usize {
        self.0.values().map(|file| file.bytes.len()).sum()
    }

    /// Contents of the files below `folder`.
    pub(crate) fn below<'a>(&'a self, folder: &'a str) -> impl Iterator<Item = &'a [u8]> {
        self.0.iter().filter(move |(path, _)| path.starts_with(folder)).map(|(_, file)| file.bytes.as_slice())
    }

    /// Writes a tar archive with `top` before every path, folders before what is in them.
    pub(crate) fn tar<W: Write>(&self, top: &str, time_s: u64, into: W) -> Result<W, Failure> {
        let mut archive = tar::Builder::new(into);
        let mut folders = std::collections::BTreeSet::new();
        let header = |kind: tar::EntryType, mode: u32, size: u64| {
            let mut header = tar::Header::new_gnu();
            header.set_entry_type(kind);
            header.set_mode(mode);
            header.set_size(size);
            header.set_mtime(time_s);
            header
        };
        for (path, file) in &self.0 {
            let path = format!("{top}/{path}");
            for (end, _) in path.match_indices('/') {
                let folder = format!("{}/", &path[..end]);
                if folders.insert(folder.clone()) {
                    archive.append_data(&mut header(tar::EntryType::Directory, 0o755, 0), &folder, std::io::empty())?;
                }
            }
            let mode = if file.executable { 0o755 } else { 0o644 };
            let size = file.bytes.len() as u64;
            archive.append_data(&mut header(tar::EntryType::Regular, mode, size), &path, file.bytes.as_slice())?;
        }
        Ok(archive.into_inner()?)
    }
}
