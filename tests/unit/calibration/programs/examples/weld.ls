/PROG  WELD
/ATTR
OWNER		= MNEDITOR;
COMMENT		= "P[1] ü";
PROTECT		= READ_WRITE;
DEFAULT_GROUP	= 1,*,*,*,*;
/MN
   1:  !Move to P[9] ;
   2:  UFRAME_NUM=1 ;
   3:  UTOOL_NUM=2 ;
   4:J P[1] 100% FINE    ;
   5:L P[2:"seam"] 500mm/sec CNT100    ;
   6:  IF DI[3]=ON,JMP LBL[1] ;
   7:  R[1]=R[1]+1    ;
   8:L P[3] 250mm/sec FINE    ;
   9:  LBL[1] ;
  10:J P[4] 20% FINE    ;
/POS
P[1]{
   GP1:
	UF : 1, UT : 2,		CONFIG : 'N U T, 0, 0, 0',
	X =    -2.992  mm,	Y =  -109.361  mm,	Z =     9.030  mm,
	W =   163.180 deg,	P =    25.206 deg,	R =     4.669 deg
};
P[2:"seam"]{
   GP1:
	UF : 1, UT : 2,		CONFIG : 'N U T, 0, 0, 0',
	X =  -109.470  mm,	Y =  -220.119  mm,	Z =   -57.564  mm,
	W =   170.900 deg,	P =     3.290 deg,	R =   -85.043 deg
};
P[3]{
   GP1:
	UF : 0, UT : 0,		CONFIG : 'F U T, 0, 0, 0',
	X =   467.294  mm,	Y =   125.254  mm,	Z =   139.194  mm,
	W =    83.172 deg,	P =   -19.575 deg,	R =    80.300 deg
};
P[4]{
   GP1:
	UF : 0, UT : 2,	
	J1=     0.000 deg,	J2=   -10.500 deg,	J3=    15.000 deg,
	J4=     0.000 deg,	J5=   -75.000 deg,	J6=     0.000 deg
};
/END
