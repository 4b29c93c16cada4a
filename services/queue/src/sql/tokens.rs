//! Access tokens.

use std::time::Duration;

use async_trait::async_trait;
use chrono::{DateTime, NaiveDate, Utc};
use ign_proto::Grant;
use sqlx::Row;
use sqlx::types::Json;

use super::super::{Backend, Connection, LOCK, to_db};
use super::rows::{internal, optional_time, parse, sql, time};
use super::{DbRow, SqlStore};
use crate::changes::Change;
use crate::check;
use crate::store::{Result, StoreError};
use crate::token::{NewToken, SecretHash, Token, TokenKey, Tokens};

const TOKEN: &str = "id, name, grants, created_at, expires_at, revoked_at, last_used_on, secret_sha256, previous_sha256, previous_until";

fn token_from(row: &DbRow) -> Result<Token> {
    let Json(grants) = row.try_get::<Json<Vec<String>>, _>("grants")?;
    Ok(Token {
        id: row.try_get("id")?,
        name: row.try_get("name")?,
        grants: grants
            .iter()
            .map(|grant| parse(grant))
            .collect::<Result<_>>()?,
        created_at: time(row, "created_at")?,
        expires_at: optional_time(row, "expires_at")?,
        revoked_at: optional_time(row, "revoked_at")?,
        last_used_on: row.try_get::<Option<NaiveDate>, _>("last_used_on")?,
    })
}

fn secret_hash(bytes: &[u8]) -> Result<SecretHash> {
    bytes.try_into().map_err(internal)
}

/// When a token made at `now` ends.
pub(super) fn end(
    now: DateTime<Utc>,
    valid_for: Option<Duration>,
) -> Result<Option<DateTime<Utc>>> {
    let Some(valid_for) = valid_for else {
        return Ok(None);
    };
    let end = chrono::TimeDelta::from_std(valid_for)
        .ok()
        .and_then(|valid_for| now.checked_add_signed(valid_for));
    end.map(Some).ok_or_else(|| StoreError::Invalid {
        field: "valid_secs",
        message: "is out of range".to_owned(),
    })
}

/// The live token with this name, or the one with this id; its row locked until the transaction ends.
async fn lock_token(connection: &mut Connection, token: &str) -> Result<Token> {
    let row = sqlx::query(sql(format!(
        "select {TOKEN} from tokens where (name = $1 and revoked_at is null) or id = $1 {LOCK}"
    )))
    .bind(token)
    .fetch_optional(connection)
    .await?;
    token_from(&row.ok_or_else(|| StoreError::NotFound {
        kind: "token",
        name: token.to_owned(),
    })?)
}

#[async_trait]
impl Tokens for SqlStore {
    async fn create_token(&self, new: NewToken) -> Result<Token> {
        check::token(&new)?;
        let (mut transaction, now) = self.begin().await?;
        let outcome = async {
            let grants: Vec<String> = new.grants.iter().map(Grant::to_string).collect();
            let row = sqlx::query(sql(format!(
                "insert into tokens (id, name, grants, secret_sha256, created_at, expires_at) \
                 values ($1, $2, $3, $4, $5, $6) on conflict do nothing returning {TOKEN}"
            )))
            .bind(&new.id)
            .bind(&new.name)
            .bind(Json(grants))
            .bind(&new.secret[..])
            .bind(to_db(now))
            .bind(end(now, new.valid_for)?.map(to_db))
            .fetch_optional(&mut *transaction)
            .await?;
            token_from(&row.ok_or_else(|| StoreError::NotAllowed {
                message: format!("there is a token {} already; rotate or revoke it", new.name),
            })?)
        }
        .await;
        self.finish(transaction, outcome, Change::Nothing).await
    }

    async fn tokens(&self) -> Result<Vec<Token>> {
        let rows = sqlx::query(sql(format!(
            "select {TOKEN} from tokens order by created_at desc, id"
        )))
        .fetch_all(self.backend.reader())
        .await?;
        rows.iter().map(token_from).collect()
    }

    async fn token_key(&self, id: &str) -> Result<Option<TokenKey>> {
        let mut reader = self.backend.reader().acquire().await?;
        let row = sqlx::query(sql(format!("select {TOKEN} from tokens where id = $1")))
            .bind(id)
            .fetch_optional(&mut *reader)
            .await?;
        let Some(row) = row else { return Ok(None) };
        let at = Backend::now(&mut reader).await?;
        let mut secrets = vec![secret_hash(row.try_get("secret_sha256")?)?];
        if let Some(previous) = row.try_get::<Option<&[u8]>, _>("previous_sha256")?
            && optional_time(&row, "previous_until")?.is_some_and(|until| at < until)
        {
            secrets.push(secret_hash(previous)?);
        }
        Ok(Some(TokenKey {
            token: token_from(&row)?,
            secrets,
            at,
        }))
    }

    async fn token_used(&self, id: &str) -> Result<()> {
        let (mut transaction, now) = self.begin().await?;
        let outcome = sqlx::query("update tokens set last_used_on = $2 where id = $1")
            .bind(id)
            .bind(now.date_naive())
            .execute(&mut *transaction)
            .await
            .map(drop)
            .map_err(StoreError::from);
        self.finish(transaction, outcome, Change::Nothing).await
    }

    async fn rotate_token(
        &self,
        token: &str,
        secret: SecretHash,
        grace: Duration,
        valid_for: Option<Duration>,
    ) -> Result<Token> {
        let (mut transaction, now) = self.begin().await?;
        let outcome = async {
            let token = lock_token(&mut transaction, token).await?;
            if token.revoked_at.is_some() {
                return Err(StoreError::NotAllowed {
                    message: format!("token {} is revoked", token.id),
                });
            }
            let expires_at = match valid_for {
                Some(_) => end(now, valid_for)?,
                None => token.expires_at,
            };
            let row = sqlx::query(sql(format!(
                "update tokens set previous_sha256 = secret_sha256, previous_until = $2, secret_sha256 = $3, \
                 expires_at = $4 where id = $1 returning {TOKEN}"
            )))
            .bind(&token.id)
            .bind(end(now, Some(grace))?.map(to_db))
            .bind(&secret[..])
            .bind(expires_at.map(to_db))
            .fetch_one(&mut *transaction)
            .await?;
            token_from(&row)
        }
        .await;
        self.finish(transaction, outcome, Change::Nothing).await
    }

    async fn revoke_token(&self, token: &str) -> Result<Token> {
        let (mut transaction, now) = self.begin().await?;
        let outcome = async {
            let token = lock_token(&mut transaction, token).await?;
            let row = sqlx::query(sql(format!(
                "update tokens set revoked_at = coalesce(revoked_at, $2), previous_sha256 = null where id = $1 \
                 returning {TOKEN}"
            )))
            .bind(&token.id)
            .bind(to_db(now))
            .fetch_one(&mut *transaction)
            .await?;
            token_from(&row)
        }
        .await;
        self.finish(transaction, outcome, Change::Nothing).await
    }
}
