//! A campaign goes on with the program that it was begun with, whatever the repository has become in the meantime: its
//! results name a commit, and that commit is checked out and built again where it is not the present one.

use std::collections::BTreeSet;
use std::ffi::{OsStr, OsString};
use std::path::Path;
use std::process::Command;

use crate::campaign::note;
use crate::error::{CampaignError, file};
use crate::program::{output, root};

/// What program, plugins and campaigns are made of.
const MADE_OF: [&str; 9] =
    ["core", "plugins", "sim-plugin", "fixtures", "tests/src", "validation/src", "Cargo.toml", "Cargo.lock", ".cargo"];

/// The package of the campaigns.
const PACKAGE: &str = "dragfree-validation";

/// The last commit that changed what program, plugins and campaigns are made of.
///
/// # Errors
/// Some of it is in no commit, so that no later session could make the program again; there is no git.
fn commit(repository: &Path) -> Result<String, CampaignError> {
    let changed = git(repository, &["status", "--porcelain", "--"], &MADE_OF)?;
    if !changed.is_empty() {
        return Err(CampaignError::Frozen(format!(
            "the program is not that of a commit, so that this campaign could not be continued later; commit first:\n{changed}"
        )));
    }
    let commit = git(repository, &["log", "-1", "--format=%H", "--"], &MADE_OF)?;
    Ok(commit.trim().to_owned())
}

/// The commit that results were made with; none where there are no results that name one.
///
/// # Errors
/// They name several.
fn begun_with<'a>(commits: impl IntoIterator<Item = &'a str>) -> Result<Option<String>, CampaignError> {
    let all: BTreeSet<&str> = commits.into_iter().filter(|commit| !commit.is_empty()).collect();
    if all.len() > 1 {
        let all = all.into_iter().collect::<Vec<_>>().join(", ");
        return Err(CampaignError::Frozen(format!("the results are of several commits ({all}); keep those of one")));
    }
    Ok(all.first().map(|commit| (*commit).to_owned()))
}

/// The present commit, where a campaign with results of these commits begins or goes on with it. Where it was begun
/// with another one, the program of that commit goes on with `arguments`, and there is none.
///
/// # Errors
/// As [`commit`], [`begun_with`] and [`go_on`].
pub(crate) fn present_or_go_on<'a>(
    commits: impl IntoIterator<Item = &'a str>,
    arguments: impl FnOnce() -> Result<Vec<OsString>, CampaignError>,
) -> Result<Option<String>, CampaignError> {
    let present = commit(root())?;
    match begun_with(commits)? {
        Some(begun) if begun != present => {
            note(&format!("going on with commit {begun}; another file of --results begins anew"));
            let arguments = arguments()?;
            go_on(root(), &begun, &arguments.iter().map(OsString::as_os_str).collect::<Vec<_>>())?;
            Ok(None)
        }
        _ => Ok(Some(present)),
    }
}

/// `--results FILE --scratch DIR` as they are from any folder.
///
/// # Errors
/// There is no present folder.
pub(crate) fn places(results: &Path, scratch: &Path) -> Result<[OsString; 4], CampaignError> {
    let absolute = |path: &Path| std::path::absolute(path).map_err(|e| file(path, &e));
    Ok(["--results".into(), absolute(results)?.into(), "--scratch".into(), absolute(scratch)?.into()])
}

/// Runs `dragfree-validation` of a commit, built in a working tree of its own below `target/frozen`.
///
/// # Errors
/// The commit is not there, does not build, or its campaign stops.
fn go_on(repository: &Path, commit: &str, arguments: &[&OsStr]) -> Result<(), CampaignError> {
    let tree = repository.join("target/frozen").join(commit);
    if !tree.exists() {
        // --force: a working tree that somebody has deleted is still known to git.
        let tree = tree.to_string_lossy();
        git(repository, &["worktree", "add", "--quiet", "--force", "--detach"], &[&tree, commit])?;
    }
    let mut run = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    run.current_dir(&tree).args(["run", "--quiet", "--release", "--package", PACKAGE, "--target-dir"]);
    run.arg(tree.join("target")).arg("--").args(arguments).stderr(std::process::Stdio::inherit());
    output(&mut run, &[0]).map(|_| ())
}

fn git(repository: &Path, command: &[&str], arguments: &[&str]) -> Result<String, CampaignError> {
    let mut git = Command::new("git");
    let said = output(git.arg("-C").arg(repository).args(command).args(arguments), &[0])?;
    Ok(String::from_utf8_lossy(&said).into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    /// A repository whose campaign writes a word of its own.
    fn repository(word: &str) -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path();
        fs::create_dir_all(folder.join("validation/src")).unwrap();
        let package = format!("[package]\nname = \"{PACKAGE}\"\nversion = \"0.1.0\"\nedition = \"2024\"\n");
        fs::write(folder.join("Cargo.toml"), "[workspace]\nmembers = [\"validation\"]\nresolver = \"3\"\n").unwrap();
        fs::write(folder.join("validation/Cargo.toml"), package).unwrap();
        fs::write(folder.join(".gitignore"), "target/\nCargo.lock\n").unwrap();
        git(folder, &["init", "--quiet"], &[]).unwrap();
        write(folder, word);
        commit_all(folder);
        dir
    }

    fn write(folder: &Path, word: &str) {
        let main = format!("fn main() {{ std::fs::write(std::env::args().nth(1).unwrap(), \"{word}\").unwrap() }}\n");
        fs::write(folder.join("validation/src/main.rs"), main).unwrap();
    }

    fn commit_all(folder: &Path) {
        git(folder, &["add", "--all"], &[]).unwrap();
        let who = ["-c", "user.name=tests", "-c", "user.email=tests@example.invalid"];
        git(folder, &who, &["commit", "--quiet", "--message", "a commit"]).unwrap();
    }

    /// Twice, as a tree that is there is used again; once more after it was deleted.
    #[test]
    fn a_campaign_goes_on_with_the_program_of_its_commit() {
        let dir = repository("first");
        let folder = dir.path();
        let first = commit(folder).unwrap();
        write(folder, "second");
        let error = commit(folder).unwrap_err().to_string();
        assert!(error.contains("commit first") && error.contains("validation/src/main.rs"), "{error}");
        commit_all(folder);
        fs::write(folder.join("results.jsonl"), "{}\n").unwrap();
        commit_all(folder);
        let second = commit(folder).unwrap();
        assert_ne!(second, first);
        assert_ne!(second, git(folder, &["rev-parse", "HEAD"], &[]).unwrap().trim(), "results change no program");

        let said = folder.join("said");
        for delete in [false, true, false] {
            go_on(folder, &first, &[said.as_os_str()]).unwrap();
            assert_eq!(fs::read_to_string(&said).unwrap(), "first");
            fs::remove_file(&said).unwrap();
            if delete {
                fs::remove_dir_all(folder.join("target/frozen").join(&first)).unwrap();
            }
        }
        assert!(go_on(folder, "0123456789", &[said.as_os_str()]).is_err());
    }

    #[test]
    fn results_name_one_commit() {
        assert_eq!(begun_with([]).unwrap(), None);
        assert_eq!(begun_with(["", ""]).unwrap(), None, "results of before");
        assert_eq!(begun_with(["a", "", "a"]).unwrap().as_deref(), Some("a"));
        assert!(begun_with(["a", "b"]).unwrap_err().to_string().contains("a, b"));
    }
}
