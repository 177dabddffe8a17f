//! Who could put other code into a plugin folder: a library runs with all rights of the program.

use std::path::Path;

use crate::input::InputFile;

/// Refuses a library that somebody could change who is neither this user, nor root, nor the owner of the program.
/// Nothing is refused where everybody may change the program itself, as in a container's folder of mode 777: whoever
/// may do that needs no plugin.
///
/// # Errors
/// The reason, with what to do.
#[cfg(unix)]
pub(super) fn check(path: &Path, file: &InputFile) -> Result<(), String> {
    use std::os::unix::fs::MetadataExt as _;
    let stat = file.metadata().map_err(|e| e.to_string())?;
    if std::env::current_exe().is_ok_and(|program| open_to_everybody(&program)) {
        return Ok(());
    }
    if stat.mode() & 0o002 != 0 {
        let mode = stat.mode() & 0o777;
        return Err(format!("may be changed by everybody (mode {mode:o}); `chmod o-w` it if you trust it"));
    }
    let trusted = trusted();
    let foreign = |owner: u32, what: &str| {
        let who = "who is neither you nor root nor the owner of the program";
        format!("{what} belongs to user {owner}, {who}; `chown` it if you trust it")
    };
    if !trusted.contains(&stat.uid()) {
        return Err(foreign(stat.uid(), "the file"));
    }
    let place = path.canonicalize().map_err(|e| e.to_string())?;
    if let Some(folder) = open_folder(&place) {
        let shown = folder.display();
        return Err(format!("its folder {shown} may be changed by everybody; `chmod o-w {shown}` if you trust it"));
    }
    let Some(folder) = place.parent() else { return Ok(()) };
    let owner = std::fs::metadata(folder).map_err(|e| e.to_string())?.uid();
    if trusted.contains(&owner) { Ok(()) } else { Err(foreign(owner, &format!("its folder {}", folder.display()))) }
}

/// Whether everybody may change a file, or put another one in its place.
#[cfg(unix)]
fn open_to_everybody(path: &Path) -> bool {
    use std::os::unix::fs::MetadataExt as _;
    let Ok(place) = path.canonicalize() else { return false };
    std::fs::metadata(&place).is_ok_and(|stat| stat.mode() & 0o002 != 0) || open_folder(&place).is_some()
}

/// The first folder above a file in which everybody may put another in its place. In one with the sticky bit, such as
/// /tmp, nobody can take away what belongs to another.
#[cfg(unix)]
fn open_folder(place: &Path) -> Option<&Path> {
    use std::os::unix::fs::MetadataExt as _;
    let open = |folder: &&Path| std::fs::metadata(folder).is_ok_and(|stat| stat.mode() & 0o1002 == 0o002);
    place.ancestors().skip(1).find(open)
}

/// This user, root, and whoever owns the program and could change it as well.
#[cfg(unix)]
fn trusted() -> [u32; 3] {
    use std::os::unix::fs::MetadataExt as _;
    let me = rustix::process::geteuid().as_raw();
    let program = std::env::current_exe().and_then(std::fs::metadata).map_or(me, |stat| stat.uid());
    [0, me, program]
}

#[cfg(not(unix))]
pub(super) fn check(_path: &Path, _file: &InputFile) -> Result<(), String> {
    Ok(())
}
