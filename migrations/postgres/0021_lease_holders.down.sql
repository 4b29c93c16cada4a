alter table jobs drop column holder_attempt;
alter table jobs drop column holder;
