//! The state of a chain as bytes: every plugin's own, and the rows that wait between them.

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::{Chain, ChainError, Queue};

const MAGIC: &[u8; 8] = b"DFSTATE3";
/// What the states of every version begin with.
const ANY_VERSION: &[u8; 7] = b"DFSTATE";

#[derive(Serialize, Deserialize)]
struct Header {
    complete_until_ns: i64,
    mission_sha256: String,
    /// Coefficients and constraints, as the plugins were told.
    model_sha256: String,
    nodes: Vec<NodeHeader>,
}

#[derive(Serialize, Deserialize, PartialEq)]
struct NodeHeader {
    name: String,
    version: String,
    sha256: String,
    parameters: serde_json::Map<String, serde_json::Value>,
    reads: Vec<String>,
}

impl Chain {
    fn header(&self) -> Header {
        let nodes = self
            .nodes
            .iter()
            .map(|n| NodeHeader {
                name: n.name().to_owned(),
                version: n.info.manifest.version.clone(),
                sha256: n.sha256.clone(),
                parameters: n.parameters.clone(),
                reads: n.reads.clone(),
            })
            .collect();
        Header {
            complete_until_ns: self.complete_until_ns,
            mission_sha256: self.mission_sha256.clone(),
            model_sha256: self.model_sha256.clone(),
            nodes,
        }
    }

    /// The whole state: a chain that loads it goes on as this one would.
    ///
    /// # Errors
    /// A plugin failed.
    pub fn save(&mut self) -> Result<Vec<u8>, ChainError> {
        let header = serde_json::to_vec(&self.header()).map_err(|e| ChainError::State { what: e.to_string() })?;
        let mut bytes = MAGIC.to_vec();
        put(&mut bytes, &header);
        for node in &mut self.nodes {
            put(&mut bytes, &node.instance.save()?);
            for queue in &mut node.inputs {
                queue.put(&mut bytes);
            }
        }
        let digest = Sha256::digest(&bytes);
        bytes.extend_from_slice(&digest);
        Ok(bytes)
    }

    /// Takes a state back; the chain must be linked as the one that saved it, and not have seen a row.
    ///
    /// # Errors
    /// [`ChainError::State`] says in what the state differs from this chain.
    pub fn load(&mut self, bytes: &[u8]) -> Result<(), ChainError> {
        let (header, mut rest) = open(bytes)?;
        self.same_chain(&header)?;
        for node in &mut self.nodes {
            node.instance.load(take(&mut rest)?)?;
            for queue in &mut node.inputs {
                queue.take(&mut rest)?;
            }
        }
        self.complete_until_ns = header.complete_until_ns;
        Ok(())
    }

    /// Whether a state was saved by a chain like this one; the sentence says in what it was not.
    fn same_chain(&self, theirs: &Header) -> Result<(), ChainError> {
        const WHAT_NEXT: &str = "replay from the start, or use the pipeline, mission, model and plugins of that run";
        let mine = self.header();
        let differs = if theirs.nodes.len() != mine.nodes.len() {
            format!("it was saved by a chain of {} plugins, this one has {}", theirs.nodes.len(), mine.nodes.len())
        } else if let Some((theirs, mine)) = theirs.nodes.iter().zip(&mine.nodes).find(|(a, b)| a != b) {
            let (name, version) = (&theirs.name, &theirs.version);
            if (name, version) != (&mine.name, &mine.version) {
                format!("it was saved by plugin {name} {version}, this chain has {} {} there", mine.name, mine.version)
            } else if theirs.parameters != mine.parameters || theirs.reads != mine.reads {
                format!("it was saved by plugin {name} {version} with other parameters or columns than here")
            } else {
                format!("it was saved by another build of plugin {name} {version} than the one found here")
            }
        } else if theirs.mission_sha256 != mine.mission_sha256 {
            "it was saved by a run with another mission file".to_owned()
        } else if theirs.model_sha256 != mine.model_sha256 {
            "it was saved by a run with another model".to_owned()
        } else {
            return Ok(());
        };
        Err(ChainError::State { what: format!("{differs}; {WHAT_NEXT}") })
    }
}

/// Where the run that saved a state stopped: every row before this time, Unix ns, is in the state.
///
/// # Errors
/// The bytes are no state.
pub fn resumes_at_ns(bytes: &[u8]) -> Result<i64, ChainError> {
    Ok(open(bytes)?.0.complete_until_ns)
}

/// The header of a sound state, and what follows it.
fn open(bytes: &[u8]) -> Result<(Header, &[u8]), ChainError> {
    let refuse = |what: &str| ChainError::State { what: what.to_owned() };
    let (body, digest) = bytes.split_last_chunk::<32>().ok_or_else(|| refuse("too short to be one"))?;
    if !body.starts_with(ANY_VERSION) {
        return Err(refuse("this file is no state of a chain"));
    }
    if !body.starts_with(MAGIC) {
        return Err(refuse(
            "it was saved by an older version of the program, which this one cannot read; replay the day before with this \
             version and --save-state, or start without --load-state",
        ));
    }
    if Sha256::digest(body).as_slice() != digest {
        return Err(refuse("it is damaged: its digest does not match; use an earlier state"));
    }
    let mut rest = &body[MAGIC.len()..];
    let header = serde_json::from_slice(take(&mut rest)?).map_err(|e| refuse(&e.to_string()))?;
    Ok((header, rest))
}

fn put(bytes: &mut Vec<u8>, part: &[u8]) {
    bytes.extend_from_slice(&(part.len() as u64).to_le_bytes());
    bytes.extend_from_slice(part);
}

fn take<'a>(rest: &mut &'a [u8]) -> Result<&'a [u8], ChainError> {
    let refuse = || ChainError::State { what: "it ends too early; use an earlier state".to_owned() };
    let (length, after) = rest.split_first_chunk::<8>().ok_or_else(refuse)?;
    let length = usize::try_from(u64::from_le_bytes(*length)).map_err(|_| refuse())?;
    let (part, after) = after.split_at_checked(length).ok_or_else(refuse)?;
    *rest = after;
    Ok(part)
}

impl Queue {
    fn put(&mut self, bytes: &mut Vec<u8>) {
        self.gather(self.rows());
        let rows = self.front(self.rows());
        put(bytes, &rows.time_ns.iter().flat_map(|t| t.to_le_bytes()).collect::<Vec<u8>>());
        for column in &rows.columns {
            put(bytes, &column.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>());
        }
    }

    fn take(&mut self, rest: &mut &[u8]) -> Result<(), ChainError> {
        fn words(part: &[u8]) -> impl Iterator<Item = [u8; 8]> {
            part.chunks_exact(8).map(|c| std::array::from_fn(|i| c[i]))
        }
        let time_ns: Vec<i64> = words(take(rest)?).map(i64::from_le_bytes).collect();
        let columns: Vec<Vec<f64>> = (0..self.columns())
            .map(|_| Ok(words(take(rest)?).map(f64::from_le_bytes).collect()))
            .collect::<Result<_, ChainError>>()?;
        if columns.iter().any(|c| c.len() != time_ns.len()) {
            return Err(ChainError::State { what: format!("the rows of table {} do not fit together", self.table) });
        }
        self.replace(time_ns, columns);
        Ok(())
    }
}
