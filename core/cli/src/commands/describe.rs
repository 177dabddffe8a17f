//! `dragfree completions` and `dragfree man`: the command line as shells and `man` want it.

use super::Done;
use crate::args::{Arguments, Shell};
use crate::failure::Failure;
use clap::CommandFactory as _;
use dragfree_archive::files::IoContext as _;
use std::path::Path;

pub(super) fn completions(shell: Shell) -> Result<Done, Failure> {
    let shell = match shell {
        Shell::Bash => clap_complete::Shell::Bash,
        Shell::Zsh => clap_complete::Shell::Zsh,
        Shell::Fish => clap_complete::Shell::Fish,
    };
    let mut text = Vec::new();
    clap_complete::generate(shell, &mut Arguments::command(), "dragfree", &mut text);
    Ok(Done::new(String::from_utf8(text)?))
}

/// A page for the program and one for each command, `dragfree-model-add.1`.
pub(super) fn man(folder: &Path) -> Result<Done, Failure> {
    std::fs::create_dir_all(folder).at("make the folder", folder)?;
    clap_mangen::generate_to(Arguments::command(), folder).at("write", folder)?;
    Ok(Done::new(String::new()))
}
