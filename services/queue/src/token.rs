//! Bearer tokens as the queue's database keeps them: who they are, what they allow, until when.
//!
//! A token has a public id, by which it is found, and a secret, of which only the SHA-256 is kept. How both are written
//! as one text is the coordinator's business.
//!
//! Invariant: a token that was revoked never comes back, and its row stays: logs name its id.

use std::time::Duration;

use async_trait::async_trait;
use chrono::{DateTime, NaiveDate, Utc};
use ign_proto::Grant;

use crate::store::Result;

/// SHA-256 of a secret.
pub type SecretHash = [u8; 32];

/// A token to make.
#[derive(Clone, Debug)]
pub struct NewToken {
    /// Public part: 12 of A-Z 0-9.
    pub id: String,
    /// Unique among the tokens that are not revoked: 1 to 63 of a-z 0-9 . _ -
    pub name: String,
    /// What it allows.
    pub grants: Vec<Grant>,
    /// Of its secret.
    pub secret: SecretHash,
    /// From now on; none for no end.
    pub valid_for: Option<Duration>,
}

/// A token without its secret.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Token {
    /// Public part.
    pub id: String,
    /// For people.
    pub name: String,
    /// What it allows.
    pub grants: Vec<Grant>,
    /// When it was made.
    pub created_at: DateTime<Utc>,
    /// When it ends by itself.
    pub expires_at: Option<DateTime<Utc>>,
    /// When it was ended.
    pub revoked_at: Option<DateTime<Utc>>,
    /// UTC day of its last use.
    pub last_used_on: Option<NaiveDate>,
}

/// What it takes to decide whether somebody who shows a token is let in.
#[derive(Clone, Debug)]
pub struct TokenKey {
    /// The token.
    pub token: Token,
    /// Hashes of the secrets that open it now: one, or two during the grace of a rotation.
    pub secrets: Vec<SecretHash>,
    /// The database's time.
    pub at: DateTime<Utc>,
}

/// The tokens of a queue.
#[async_trait]
pub trait Tokens {
    /// Makes a token.
    async fn create_token(&self, new: NewToken) -> Result<Token>;

    /// All of them, the newest first.
    async fn tokens(&self) -> Result<Vec<Token>>;

    /// What opens the token with this id, whether or not it has ended.
    async fn token_key(&self, id: &str) -> Result<Option<TokenKey>>;

    /// Notes that the token was used today.
    async fn token_used(&self, id: &str) -> Result<()>;

    /// Gives the token with this name or id another secret; the one until now is good for `grace`. It ends after
    /// `valid_for`; none keeps the end that it has.
    async fn rotate_token(
        &self,
        token: &str,
        secret: SecretHash,
        grace: Duration,
        valid_for: Option<Duration>,
    ) -> Result<Token>;

    /// Ends the token with this name or id; again does nothing.
    async fn revoke_token(&self, token: &str) -> Result<Token>;
}
