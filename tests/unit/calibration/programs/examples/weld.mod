MODULE Weld
  ! "PERS tooldata tNone:=..." is a comment; MoveL pNone
  PERS tooldata tGun:=[TRUE,[[0,20,150],[0.9659258262890683,0,0.25881904510252074,0]],[1.5,[0,0,60],[1,0,0,0],0,0,0]];
  TASK PERS wobjdata wTable:=[FALSE,TRUE,"",[[300,50,100],[0.7071067811865476,0,0,0.7071067811865476]],[[10,-20,30],[1,0,0,0]]];
  CONST robtarget p10:=[[89.304689,-89.739977,94.198272],[0.067634928,-0.038333280,-0.989694324,0.120254821],[0,0,-2,0],[9E9,9E9,9E9,9E9,9E9,9E9]];
  LOCAL CONST robtarget p20:=[[-180.453047,-285.706894,390.352299],[0.742581671,0.382926425,-0.111186040,0.538124038],
    [-1,-1,1,1],[9E9,9E9,9E9,9E9,9E9,9E9]];
  PERS robtarget p30:=[[-3.758507,-77.668532,121.263245],[0.092949682,-0.672514481,-0.728465786,-0.091772704],[0,0,0,0],[9E+09,9E+09,9E+09,9E+09,9E+09,9E+09]];
  CONST jointtarget jHome:=[[0,-10.5,20,0,30,0],[9E9,9E9,9E9,9E9,9E9,9E9]];

  PROC main()
    ConfL\On;
    MoveAbsJ jHome\NoEOffs,v200,fine,tGun\WObj:=wTable;
    TPWrite "MoveJ p10; now";
    FOR i FROM 1 TO 3 DO
      MoveJ p10,v500,z10,tGun\WObj:=wTable;
      MoveL p20, v100, fine, tGun \WObj:=wTable;
    ENDFOR
    MoveL Offs(p30,0,0,40),v100,z5,tGun\WObj:=wTable;
    MoveL p30,v50\V:=40,fine,tGun\WObj:=wTable;
    MoveL RelTool(p30,5,0,-30\Rx:=4\Rz:=-15),v100,fine,tGun\WObj:=wTable;
    SetDO doGrip,1;
    MoveJ [[367.849541,54.073359,394.844810],[0.122089534,0.035811718,0.988447660,0.082358298],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]],v500,fine,tool0;
  ENDPROC
ENDMODULE
